"""A session with one MCU: the greeting, a puppet's tables, and the performance.

session = Session(SerialCarrier("/dev/ttyACM0"))
session.open()
session.upload(build_tables(puppet, robot))
session.start()
session.weight_targets(FRAME_NOW, {0: weight_q28(1.0)})
session.pump(20_000)        # often: at least every 200 ms, or the MCU finds the link silent
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial

from marotte.link import Carrier, Link, LinkError, LinkRefused, LinkSilent, Message
from marotte.puppet import Puppet
from marotte.tables import Tables, items_per_message, keeps
from shared import codec, messages

OPEN_TIMEOUT_S = 1.5
UPLOAD_TIMEOUT_S = 5.0
PING_US = 100_000
GREETING_US = 150_000
STEP_US = 2_000
"""Longest wait for one look at the carrier while something is expected."""

DICTIONARY = codec.crc32(messages.canonical_text().encode())


class LinkForeign(LinkError):
    """What answers at the port is not this version of Marotte's firmware."""


class Session:
    """One host and one MCU. All methods raise LinkError, or what the carrier raises, when the MCU or the port is gone.

    `welcome` holds the fields of the MCU's greeting. `taps` collects `(frame, taps, values_q15)` as telemetry brings
    them: the values of all DOFs, base, signal and motor one after the other as far as `taps` names them. `weights` is
    `(frame, {action: weight_q12})` of the last weights message.
    """

    def __init__(self, carrier: Carrier):
        self.carrier = carrier
        self.link = Link(carrier, self._on_message)
        self.welcome: dict[str, int] = {}
        self.taps: deque[tuple[int, int, list[int]]] = deque()
        self.weights: tuple[int, dict[int, int]] = (-1, {})
        self._status: dict[str, int] = {}
        self._posted_us = carrier.now_us()

    def open(self, timeout_s: float = OPEN_TIMEOUT_S) -> None:
        """Greet the MCU, at first or again. Raises LinkSilent if nothing answers in time, LinkForeign if something else does."""
        carrier = self.carrier
        end_us = carrier.now_us() + round(timeout_s * 1e6)
        refused: list[int] = []
        self.welcome = {}
        while not self.welcome:
            if carrier.now_us() >= end_us:
                raise self._no_welcome(timeout_s)
            carrier.write(b"\0")  # whatever was half sent before ends here
            self.link.forget()
            hello = {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY}
            self._post("hello", hello, on_refused=lambda status, _: refused.append(status))
            again_us = min(carrier.now_us() + GREETING_US, end_us)
            while not self.welcome and carrier.now_us() < again_us:
                self.link.pump(STEP_US)
        theirs = (self.welcome["protocol"], self.welcome["dictionary"])
        if refused or theirs != (messages.PROTOCOL, DICTIONARY):
            raise LinkForeign(
                f"the firmware speaks protocol {theirs[0]}, dictionary {theirs[1]:08x}; "
                f"this program speaks protocol {messages.PROTOCOL}, dictionary {DICTIONARY:08x}: "
                "flash the firmware of this version"
            )
        self.flush()

    def upload(self, tables: Tables, progress: Callable[[int, int], None] | None = None) -> None:
        """Stop the motion, load a puppet's tables. `progress(done, all)` is called as they are acknowledged.

        Raises LinkRefused if the MCU refuses a part; the tables that it had before then stay as they were.
        """
        self.stop()
        parts = list(tables.messages())
        refused: list[LinkRefused] = []
        for name, fields, items in parts:
            self._post(name, fields, items, partial(_note_refusal, refused, name))
        end_us = self.carrier.now_us() + round(UPLOAD_TIMEOUT_S * 1e6)
        while self.link.pending:
            self._step(end_us, "the puppet's tables were not acknowledged")
            if progress:
                progress(max(0, len(parts) - self.link.pending), len(parts))
        if refused:
            raise refused[0]

    def exchange(self, tables: Tables, playing: Puppet) -> None:
        """Replace the tables of a puppet that moves, at the beginning of a frame.

        `playing` is the puppet whose tables the MCU has; actions, DOFs and live channels that keep their names keep weights,
        phases, poses and values. The frame rate has to be the same. Raises LinkRefused if the MCU refuses a part; the old tables
        then play on.
        """
        begin, *parts = tables.messages()
        commit = parts.pop()
        for group in ([begin, *parts, *keeps(playing, tables.puppet)], [commit]):
            refused = self._post_all(group)
            if refused:
                raise refused[0]
        end_us = self.carrier.now_us() + round(UPLOAD_TIMEOUT_S * 1e6)
        while self._post_all([begin]):  # refused as long as the exchange is being prepared
            self._step(end_us, "the exchange of tables was not carried out")

    def _post_all(self, group: list[tuple[str, dict[str, int], list[dict[str, int]]]]) -> list[LinkRefused]:
        """Send commands, wait until all are answered; return what the MCU refused."""
        refused: list[LinkRefused] = []
        for name, fields, items in group:
            self._post(name, fields, items, partial(_note_refusal, refused, name))
        self.flush(UPLOAD_TIMEOUT_S)
        return refused

    def start(self) -> None:
        """Begin the motion: frame 0 is due when the MCU takes this command."""
        self._post("start")

    def stop(self) -> None:
        """End the motion; what waits for its frame is forgotten, relative DOFs stand."""
        self._post("stop")

    def arm(self) -> None:
        """Let pulses flow."""
        self._post("arm")

    def kill(self) -> None:
        """Take all pulses away, before anything else that has not been sent yet; an `arm` among that is withdrawn."""
        self.link.withdraw("arm")
        self._posted_us = self.carrier.now_us()
        self.link.post("kill", urgent=True)

    def weight_targets(
        self, frame: int, targets_q28: dict[int, int], on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Send weight targets by index of action, to act in `frame` or at once (FRAME_NOW)."""
        items = [{"action": action, "target_q28": target} for action, target in targets_q28.items()]
        self._post_items("weight_targets", frame, items, on_refused)

    def live_targets(
        self, frame: int, targets_q28: dict[int, int], on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Send targets of live channels by index, to act in `frame` or at once (FRAME_NOW)."""
        items = [{"live": live, "target_q28": target} for live, target in targets_q28.items()]
        self._post_items("live_targets", frame, items, on_refused)

    def tempo(
        self, frame: int, action: int, tempo_q16: int, on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Set the tempo of an action by its index, or of all (MASTER), from `frame` on or at once (FRAME_NOW)."""
        self._post_items("tempo", frame, [{"action": action, "tempo_q16": tempo_q16}], on_refused)

    def telemetry(self, taps: int, taps_every: int, weights_every: int) -> None:
        """Ask for taps (bits of TAP_BASE, TAP_SIGNAL, TAP_MOTOR) and weights, every so many frames; 0 is never."""
        self._post("telemetry", {"taps": taps, "taps_every": taps_every, "weights_every": weights_every})

    def status(self, timeout_s: float = 1.0) -> dict[str, int]:
        """Return the MCU's counters: the fields of the status message."""
        self._status = {}
        self._post("status_request")
        end_us = self.carrier.now_us() + round(timeout_s * 1e6)
        while not self._status:
            self._step(end_us, "the MCU sent no status")
        return self._status

    def pump(self, wait_us: int) -> None:
        """Let at most `wait_us` pass, take what has come, keep the link alive."""
        if self.carrier.now_us() - self._posted_us >= PING_US:
            self._post("ping")
        self.link.pump(wait_us)

    def flush(self, timeout_s: float = 1.0) -> None:
        """Wait until every command is acknowledged."""
        end_us = self.carrier.now_us() + round(timeout_s * 1e6)
        while self.link.pending:
            self._step(end_us, "commands were not acknowledged")

    def close(self) -> None:
        """Close the port. It does not stop the puppet: `stop` and `kill` do."""
        self.carrier.close()

    def _step(self, end_us: int, complaint: str) -> None:
        if self.carrier.now_us() >= end_us:
            raise LinkSilent(complaint + " in time")
        self.pump(STEP_US)

    def _post(
        self,
        name: str,
        fields: dict[str, int] | None = None,
        items: list[dict[str, int]] | None = None,
        on_refused: Callable[[int, int], None] | None = None,
    ) -> None:
        self._posted_us = self.carrier.now_us()
        self.link.post(name, fields, items, on_refused)

    def _post_items(
        self, name: str, frame: int, items: list[dict[str, int]], on_refused: Callable[[int, int], None] | None
    ) -> None:
        room = items_per_message(name)
        for start in range(0, len(items), room):
            self._post(name, {"frame": frame}, items[start : start + room], on_refused)

    def _on_message(self, message: Message) -> None:
        if message.name == "welcome":
            self.welcome = message.fields
        elif message.name == "taps":
            values = [item["value_q15"] for item in message.items]
            self.taps.append((message.fields["frame"], message.fields["taps"], values))
        elif message.name == "weights":
            weights = {item["action"]: item["weight_q12"] for item in message.items}
            self.weights = (message.fields["frame"], weights)
        elif message.name == "status":
            self._status = message.fields

    def _no_welcome(self, timeout_s: float) -> LinkError:
        if b">>>" in self.link.tail or b"raw REPL" in self.link.tail:
            return LinkForeign(
                "MicroPython's REPL answers at this port, not Marotte's firmware: reset the MCU, "
                "for example with `mpremote reset`; if that does not help, flash the firmware"
            )
        if self.link.counters.bytes:
            return LinkForeign("what answers at this port is not Marotte's firmware; flash it, or choose another port")
        return LinkSilent(f"no answer within {timeout_s:g} s: is the firmware running on the MCU?")


def _note_refusal(refused: list[LinkRefused], name: str, status: int, detail: int) -> None:
    refused.append(LinkRefused(name, status, detail))
