"""Stamped targets: what the host sends waits here for the frame in which it acts.

A target is a weight target, a live channel's target, a tempo or a gain. Targets of one frame act in the order of their arrival.
All storage is preallocated; what does not fit is refused whole, and the host sends it again.
"""

from array import array

import micropython
from micropython import const

from shared import messages
from shared.formats import (
    GAIN4_MAX,
    MASTER,
    MASTER_TEMPO_MAX_Q16,
    MASTER_TEMPO_MIN_Q16,
    QUEUE_MAX,
    TEMPO_MAX_Q16,
    TEMPO_MIN_Q16,
    WEIGHT_MAX,
    WEIGHT_ONE,
)

WEIGHT = const(0)
LIVE = const(1)
TEMPO = const(2)
GAIN = const(3)
MASTER_INDEX = const(255)
_REFUSED_MAX = const(0x3FFFFF00)  # where that count stays, as a larger one would need memory
_NOW = const(128)  # added to the kind of a target that acts in the next frame and cannot be late


@micropython.viper
def _put(
    body: ptr8,
    start: int,
    items: int,
    kind: int,
    first_index: int,
    indices: int,
    least: int,
    most: int,
    queue_frame: ptr32,
    queue_kind: ptr8,
    queue_index: ptr8,
    queue_value: ptr32,
    count: int,
) -> int:
    """Append `items` targets of 5 bytes (index, value as 32 bits); return -1, or the place of a bad field.

    Nothing is stored unless all indices lie in first_index .. first_index + indices - 1 and all values in least..most.
    The payload begins at `start` with the stamp, -1 for now. Values are below 2^31 once the top byte has been looked
    at. A bad stamp is place 0, then every item has two places, as in the acknowledgement's detail.
    """
    if int(body[start + 3]) & 128:
        if (int(body[start]) & int(body[start + 1]) & int(body[start + 2]) & int(body[start + 3])) != 255:
            return 0
        frame = 0
        kind = kind | 128
    else:
        frame = (
            int(body[start])
            | (int(body[start + 1]) << 8)
            | (int(body[start + 2]) << 16)
            | (int(body[start + 3]) << 24)
        )
    n = 0
    while n < items:
        at = start + 4 + 5 * n
        index = int(body[at])
        if index < first_index or index >= first_index + indices:
            return 1 + 2 * n
        if body[at + 4] >= 128:
            return 2 + 2 * n
        value = (
            int(body[at + 1])
            | (int(body[at + 2]) << 8)
            | (int(body[at + 3]) << 16)
            | (int(body[at + 4]) << 24)
        )
        if value < least or value > most:
            return 2 + 2 * n
        # Stored beyond `count`, so it does not exist until the caller counts it.
        queue_frame[count + n] = frame
        queue_kind[count + n] = kind
        queue_index[count + n] = index
        queue_value[count + n] = value
        n += 1
    return -1


@micropython.viper
def _apply(
    frame: int,
    consume: int,
    count: int,
    queue_frame: ptr32,
    queue_kind: ptr8,
    queue_index: ptr8,
    queue_value: ptr32,
    weight_target_q28: ptr32,
    live_target_q28: ptr32,
    tempo_q16: ptr32,
    action_tempo_q16: ptr32,
    gain4_q16: ptr32,
    counts: ptr32,
) -> int:
    """Let all targets stamped `frame` or earlier act; return how many wait: without `consume` all of them, and none is late.

    `counts[0]` counts the late ones, up to 2^30 - 1, `counts[1]` the tempos of actions, `counts[2]` all but gains; `counts[3]`
    gets a bit per live channel whose target acted.
    """
    kept = 0
    n = 0
    while n < count:
        if queue_frame[n] <= frame:
            kind = int(queue_kind[n])
            if kind < 128:
                if queue_frame[n] < frame and consume and counts[0] < 0x3FFFFFFF:
                    counts[0] = counts[0] + 1
            kind = kind & 127
            index = int(queue_index[n])
            if kind == GAIN:
                gain4_q16[index] = queue_value[n]
            else:
                counts[2] = counts[2] + 1
                if kind == WEIGHT:
                    weight_target_q28[index] = queue_value[n]
                elif kind == LIVE:
                    live_target_q28[index] = queue_value[n]
                    counts[3] = counts[3] | (1 << index)
                elif index == MASTER_INDEX:
                    tempo_q16[0] = queue_value[n]
                else:
                    action_tempo_q16[index] = queue_value[n]
                    counts[1] = counts[1] + 1
        elif consume:
            if kept != n:
                queue_frame[kept] = queue_frame[n]
                queue_kind[kept] = queue_kind[n]
                queue_index[kept] = queue_index[n]
                queue_value[kept] = queue_value[n]
            kept += 1
        n += 1
    return kept if consume else count


@micropython.viper
def _is_news(frame: int, count: int, queue_frame: ptr32, queue_kind: ptr8) -> int:
    """Return 1 if a target of anything but a gain will act in `frame`, else 0."""
    n = 0
    while n < count:
        if queue_frame[n] <= frame and (int(queue_kind[n]) & 127) != GAIN:
            return 1
        n += 1
    return 0


@micropython.viper
def _renumber(
    count: int,
    queue_frame: ptr32,
    queue_kind: ptr8,
    queue_index: ptr8,
    queue_value: ptr32,
    keep_action: ptr8,
    actions: int,
    keep_live: ptr8,
    lives: int,
) -> int:
    """Let targets that wait mean the new places of what they meant; return how many are left."""
    kept = 0
    n = 0
    while n < count:
        index = int(queue_index[n])
        kind = int(queue_kind[n]) & 127
        place = -1
        if kind == GAIN or (kind == TEMPO and index == MASTER_INDEX):
            place = index
        elif kind == LIVE:
            i = 0
            while i < lives:
                if keep_live[i] == index:
                    place = i
                i += 1
        else:
            i = 0
            while i < actions:
                if keep_action[i] == index:
                    place = i
                i += 1
        if place >= 0:
            queue_frame[kept] = queue_frame[n]
            queue_kind[kept] = queue_kind[n]
            queue_value[kept] = queue_value[n]
            queue_index[kept] = place
            kept += 1
        n += 1
    return kept


class Cues:
    """The queue of stamped targets.

    `counts[0]` counts targets that came after their frame and acted at once, `counts[1]` tempos of actions that acted.
    `counts[2]` counts the targets of the last frame that change what is to come, that is all but gains; `counts[3]` has a
    bit per live channel that got a target in it. `arrivals` moves on with every payload that is queued. `refused` counts
    targets that found no place. `detail` explains the last refusal: the number of the bad field, or the free places.
    """

    def __init__(self):
        self.count = 0
        self.arrivals = 0
        self.detail = 0
        self.refused = 0
        self.counts = array("i", (0, 0, 0, 0))
        self._frame = array("i", bytes(4 * QUEUE_MAX))
        self._kind = bytearray(QUEUE_MAX)
        self._index = bytearray(QUEUE_MAX)
        self._value = array("i", bytes(4 * QUEUE_MAX))

    def clear(self):
        """Forget all that wait."""
        self.count = 0

    def renumber(self, keep_action, actions, keep_live, lives):
        """Follow an exchange of tables: the lists say what each new action and live channel was. What is gone is dropped."""
        # fmt: off
        self.count = _renumber(
            self.count, self._frame, self._kind, self._index, self._value, keep_action, actions, keep_live, lives
        )
        # fmt: on

    def put(self, kind, body, start, length, indices):
        """Queue the targets of a payload, or none of them; return a status.

        The payload has `length` bytes at `body[start]`: the stamp, then items of index and value.
        `indices` is the number of actions, live channels or bands.
        """
        items = (length - 4) // 5
        if self.count + items > QUEUE_MAX:
            self.detail = QUEUE_MAX - self.count
            if self.refused < _REFUSED_MAX:
                self.refused += items
            return messages.FULL
        first = least = 0
        if kind == TEMPO:
            least, most = TEMPO_MIN_Q16, TEMPO_MAX_Q16
            if items == 1 and body[start + 4] == MASTER:
                first, indices = MASTER, 1
                least, most = MASTER_TEMPO_MIN_Q16, MASTER_TEMPO_MAX_Q16
        elif kind == GAIN:
            most = GAIN4_MAX
        else:
            most = WEIGHT_MAX if kind == WEIGHT else WEIGHT_ONE
        # fmt: off
        bad = _put(
            body, start, items, kind, first, indices, least, most,
            self._frame, self._kind, self._index, self._value, self.count,
        )
        # fmt: on
        if bad >= 0:
            self.detail = bad
            return messages.RANGE
        self.count += items
        self.arrivals = (self.arrivals + 1) & 0xFFFF
        return messages.OK

    def has_news(self, frame):
        """Return whether anything will act in `frame` that changes what is to come."""
        return self.count != 0 and _is_news(frame, self.count, self._frame, self._kind) != 0

    # fmt: off
    def apply(
        self, frame, weight_target_q28, live_target_q28, tempo_q16, action_tempo_q16, gain4_q16, consume=True
    ):
        # fmt: on
        """Let the targets due in `frame` act on the arrays; `tempo_q16[0]` is the master tempo.

        Without `consume` they stay in the queue, to act again.
        """
        self.counts[2] = self.counts[3] = 0
        if self.count == 0:
            return
        # fmt: off
        self.count = _apply(
            frame, 1 if consume else 0, self.count, self._frame, self._kind, self._index, self._value,
            weight_target_q28, live_target_q28, tempo_q16, action_tempo_q16, gain4_q16, self.counts,
        )
        # fmt: on
