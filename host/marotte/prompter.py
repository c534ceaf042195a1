"""Sending a score's steps to the MCU ahead of their frames, so that no jitter of the link or of this machine is heard.

Each target is stamped with the frame in which it acts, and waits for it in the MCU's queue. The prompter keeps count of the
targets that wait there and sends no more than the queue has room for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Protocol

from marotte.score import Step
from marotte.tables import gain4_q16, tempo_q16, weight_q28
from shared import formats

AHEAD_FRAMES = 30
"""How far ahead of the frame that the MCU has reached steps are sent."""


class Directed(Protocol):
    """The part of a session that a score needs."""

    def weight_targets(self, frame: int, targets_q28: dict[int, int]) -> None: ...
    def live_targets(self, frame: int, targets_q28: dict[int, int]) -> None: ...
    def tempo(self, frame: int, action: int, tempo_q16: int) -> None: ...
    def gains(self, frame: int, gains4_q16: dict[int, int]) -> None: ...


class Prompter:
    """Plays the steps of a score into a session."""

    def __init__(self, session: Directed, steps: Sequence[Step], queue_max: int = formats.QUEUE_MAX) -> None:
        """`queue_max` is the number of targets that the MCU's queue holds."""
        self._session = session
        self._steps = deque(steps)
        self._queue_max = queue_max
        self._waiting: deque[tuple[int, int]] = deque()  # frame, targets
        self._waiting_targets = 0

    @property
    def is_done(self) -> bool:
        """Whether every step is sent."""
        return not self._steps

    def reached(self, frame: int) -> list[Step]:
        """Send what is due soon, the MCU having computed `frame` (-1: none yet); return the steps sent."""
        while self._waiting and self._waiting[0][0] <= frame:
            self._waiting_targets -= self._waiting.popleft()[1]
        sent = []
        while self._steps and self._steps[0].frame <= frame + AHEAD_FRAMES:
            size = _targets(self._steps[0])
            if self._waiting_targets + size > self._queue_max:
                break
            step = self._steps.popleft()
            self._send(step)
            self._waiting.append((step.frame, size))
            self._waiting_targets += size
            sent.append(step)
        return sent

    def _send(self, step: Step) -> None:
        frame = step.frame
        if step.weights:
            self._session.weight_targets(frame, {index: weight_q28(target) for index, target in step.weights.items()})
        if step.gains is not None:
            self._session.gains(frame, {band: gain4_q16(gain) for band, gain in enumerate(step.gains)})
        if step.lives:
            self._session.live_targets(frame, {index: weight_q28(target) for index, target in step.lives.items()})
        if step.master_tempo is not None:
            self._session.tempo(frame, formats.MASTER, tempo_q16(step.master_tempo))
        for action, tempo in step.tempos.items():
            self._session.tempo(frame, action, tempo_q16(tempo))


def _targets(step: Step) -> int:
    has_master_tempo = step.master_tempo is not None
    return len(step.weights) + len(step.gains or ()) + len(step.lives) + len(step.tempos) + has_master_tempo
