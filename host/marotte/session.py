"""A session with one MCU: the greeting, a puppet's tables, and the performance.

session = Session(SerialCarrier("/dev/ttyACM0"))
session.open()
session.upload(build_tables(puppet, robot))
session.arm()
session.wait_attached()     # if it is to move from its first frame on
session.start()
session.weight_targets(FRAME_NOW, {0: weight_q28(1.0)})
session.pump(20_000)        # often: at least every 200 ms, or the MCU finds the link silent
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

from marotte.keeping import kept
from marotte.limits import Limits
from marotte.link import Carrier, Link, LinkError, LinkRefused, LinkSilent, Message
from marotte.outputs import Output
from marotte.puppet import Puppet
from marotte.tables import Message as Command
from marotte.tables import Tables, calibration_fields, items_per_message, keeps, limit_fields
from shared import codec, formats, messages

OPEN_TIMEOUT_S = 1.5
UPLOAD_TIMEOUT_S = 5.0
"""For the next of a puppet's tables that is acknowledged."""
SAVE_TIMEOUT_S = 10.0
"""Erasing and writing flash keeps the MCU from answering for a while."""
ATTACH_TIMEOUT_S = 2.0
"""Beyond the intervals at which outputs are attached."""
LOOK_US = 20_000
"""How often the MCU is asked while its outputs are being attached."""
WEIGHTS_KEPT = 64
"""Messages with weights that wait for whoever wants them all."""
PING_US = 160_000
PINGS = 3
"""At least so many fit into a robot's `link_timeout`."""
STREAM_US = 160_000
"""How often targets that change all the time are sent: six of them, with their answers, take less than 3 % of a UART at 115200
baud. Weights follow them through two filters, which at the default `tau` let little pass that is quicker.
"""
GREETING_US = 50_000
STEP_US = 2_000
"""Longest wait for one look at the carrier while something is expected."""

TAPS_KEPT = 1 << 16
"""Frames whose taps wait to be taken; of more than that, the oldest are dropped."""

DICTIONARY = codec.crc32(messages.canonical_text().encode())


class LinkForeign(LinkError):
    """What answers at the port is not this version of Marotte's firmware."""


class LinkKilled(LinkError):
    """The outputs have lost their pulses, or not got them."""


KILLERS = {
    formats.KILLED_BY_NOBODY: "nobody",
    formats.KILLED_BY_HOST: "the host",
    formats.KILLED_BY_PIN: "the kill pin",
    formats.KILLED_BY_STOPPED_TICKS: "the firmware, as the motor layer's ticks had stopped",
}


def killer(status: dict[str, int]) -> str:
    """Return who took the pulses away last, as a status says."""
    return KILLERS.get(status["killed_by"], f"cause {status['killed_by']}")


class Session:
    """One host and one MCU. All methods raise LinkError, or what the carrier raises, when the MCU or the port is gone.

    `welcome` holds the fields of the MCU's greeting. `taps` collects `(frame, taps, values_q15)` as telemetry brings
    them, the newest TAPS_KEPT: the values of all DOFs, base, signal and motor one after the other as far as `taps` names them.
    `weights` is `(frame, {action: weight_q12})` of the last weights message, `weights_seen` has the last WEIGHTS_KEPT of them.
    """

    def __init__(self, carrier: Carrier):
        self.carrier = carrier
        self.link = Link(carrier, self._on_message)
        self.welcome: dict[str, int] = {}
        self.taps: deque[tuple[int, int, list[int]]] = deque(maxlen=TAPS_KEPT)
        self.weights: tuple[int, dict[int, int]] = (-1, {})
        self.weights_seen: deque[tuple[int, dict[int, int]]] = deque(maxlen=WEIGHTS_KEPT)
        self._tables: Tables | None = None
        self._status: dict[str, int] = {}
        self._motor_status: dict[str, int] = {}
        self._posted_us = carrier.now_us()
        self._ping_us = PING_US
        self._stream: dict[int, int] = {}  # targets that wait for their turn
        self._streamed_us = self._posted_us - STREAM_US

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
            self._stream = {}
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
        for pending in self._flushing(UPLOAD_TIMEOUT_S, "the puppet's tables were not acknowledged"):
            if progress:
                progress(max(0, len(parts) - pending), len(parts))
        if refused:
            raise refused[0]
        self._plays(tables, parts[0])

    def exchange(self, tables: Tables, playing: Puppet) -> None:
        """Replace the tables of a puppet that moves, between two frames.

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
        self._plays(tables, begin)

    def _plays(self, tables: Tables, begin: Command) -> None:
        """Note which tables the MCU plays now, and how soon it finds the link silent, which their first message says."""
        self._tables = tables
        self._ping_us = min(PING_US, begin[1]["link_timeout_ms"] * 1000 // PINGS)

    def _post_all(self, group: list[Command], timeout_s: float = UPLOAD_TIMEOUT_S) -> list[LinkRefused]:
        """Send commands, wait until all are answered; return what the MCU refused."""
        refused: list[LinkRefused] = []
        for name, fields, items in group:
            self._post(name, fields, items, partial(_note_refusal, refused, name))
        self.flush(timeout_s)
        return refused

    def start(self) -> None:
        """Begin the motion: frame 0 is due when the MCU takes this command."""
        self._post("start")

    def stop(self) -> None:
        """End the motion; what waits for its frame is forgotten, relative DOFs stand."""
        self._post("stop")

    def arm(self) -> None:
        """Let pulses flow: the outputs are attached one after the other, each from where its DOF was last."""
        self._post("arm")

    def wait_attached(self, timeout_s: float | None = None) -> None:
        """Wait until all outputs of the tables have been attached after `arm`.

        The default timeout is what their intervals take, and a little more. Raises LinkKilled if that does not happen, or if
        somebody has killed them meanwhile.
        """
        tables = self._tables
        if tables is None:
            raise LinkError("nothing to wait for: this session has uploaded no tables")
        wanted = tables.outputs_mask
        if timeout_s is None:
            timeout_s = wanted.bit_count() * tables.robot.attach_interval_s + ATTACH_TIMEOUT_S
        end_us = self.carrier.now_us() + round(timeout_s * 1e6)
        self.flush()
        while True:
            status = self.status()
            missing = wanted & ~(status["attached"] | status["released"] | status["stalled"])
            if not missing:
                return
            if not status["armed"]:
                raise LinkKilled(f"the outputs are off again: killed by {killer(status)}")
            if self.carrier.now_us() >= end_us:
                names = [name for index, name in enumerate(tables.puppet.dofs) if missing >> index & 1]
                raise LinkKilled(f"{', '.join(names)}: no pulses after {timeout_s:g} s; are all chips connected?")
            self.pump(LOOK_US)

    def calibrate(self, output: Output) -> None:
        """Change the calibration of one of the robot's outputs, while it plays; what the MCU keeps on its flash stays as it is.

        Raises KeyError if the tables that play have no such DOF.
        """
        index, _ = self._dof(output.dof)
        self._post("calibrate", {"dof": index, **calibration_fields(output)})

    def limit(self, dof: str, limits: Limits) -> None:
        """Hold a DOF to these limits and to the puppet's, the tighter of both, while it plays.

        Raises KeyError if the tables that play have no such DOF.
        """
        index, tables = self._dof(dof)
        known = tables.puppet.dofs[dof]
        self._post("limit", {"dof": index, **limit_fields(known.limits_with(limits), known, tables.tick_s)})

    def save(
        self, tables: Tables, behaviour: str | None = None, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Let the MCU keep a puppet and its robot on its flash: it plays them by itself when it is switched on.

        `behaviour` names what it does then; by default it stands at rest. `progress(done, all)` is called as it goes on. Raises
        LinkRefused while frames run or outputs are armed, LinkError for a puppet that is too large, KeyError for an unknown
        behaviour.
        """
        data = kept(tables, behaviour)
        if len(data) > formats.STORE_MAX:
            raise LinkError(f"the puppet takes {len(data)} bytes, but the MCU keeps {formats.STORE_MAX} at most")
        room = items_per_message("save")
        parts: list[Command] = [("save_begin", {"bytes": len(data), "crc32": codec.crc32(data)}, [])]
        for place in range(0, len(data), room):
            parts.append(("save", {"place": place}, [{"byte": byte} for byte in data[place : place + room]]))
        parts.append(("save_end", {}, []))
        for number, part in enumerate(parts):
            refused = self._post_all([part], SAVE_TIMEOUT_S)
            if refused:
                raise refused[0]
            if progress:
                progress(number + 1, len(parts))

    def erase_saved(self) -> None:
        """Let the MCU forget what it keeps on its flash. Raises LinkRefused while frames run or outputs are armed."""
        self._post("save_erase")
        self.flush(SAVE_TIMEOUT_S)

    def _dof(self, name: str) -> tuple[int, Tables]:
        if self._tables is None or name not in self._tables.puppet.dofs:
            raise KeyError(name)
        return list(self._tables.puppet.dofs).index(name), self._tables

    def kill(self) -> None:
        """Take all pulses away, before anything else that has not been sent yet; an `arm` among that is withdrawn."""
        self.link.withdraw("arm")
        self._posted_us = self.carrier.now_us()
        self.link.post("kill", urgent=True)

    def weight_targets(
        self, frame: int, targets_q28: dict[int, int], on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Send weight targets by index of action, to act in `frame` or at once (FRAME_NOW).

        What is to act at once takes the place of older targets of that kind for the same actions that have not left yet.
        """
        items = [{"action": action, "target_q28": target} for action, target in targets_q28.items()]
        self._post_items("weight_targets", frame, items, on_refused, "action")

    def stream_weights(self, targets_q28: dict[int, int]) -> None:
        """Send weight targets that change all the time, as those of sliders do, to act at once.

        They go out if none have for STREAM_US, else then, the newest of each action; the last ones always.
        """
        self._stream.update(targets_q28)
        self._send_stream()

    def _send_stream(self, at_once: bool = False) -> None:
        if self._stream and (at_once or self.carrier.now_us() - self._streamed_us >= STREAM_US):
            self._streamed_us = self.carrier.now_us()
            targets_q28, self._stream = self._stream, {}
            self.weight_targets(formats.FRAME_NOW, targets_q28)

    def live_targets(
        self, frame: int, targets_q28: dict[int, int], on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Send targets of live channels by index, to act in `frame` or at once (FRAME_NOW), like weight targets."""
        items = [{"live": live, "target_q28": target} for live, target in targets_q28.items()]
        self._post_items("live_targets", frame, items, on_refused, "live")

    def tempo(
        self, frame: int, action: int, tempo_q16: int, on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Set the tempo of an action by its index, or of all (MASTER), from `frame` on or at once (FRAME_NOW)."""
        self._post_items("tempo", frame, [{"action": action, "tempo_q16": tempo_q16}], on_refused)

    def gains(
        self, frame: int, gains4_q16: dict[int, int], on_refused: Callable[[int, int], None] | None = None
    ) -> None:
        """Send gains of bands by index, the highest 0, from `frame` on or at once (FRAME_NOW)."""
        items = [{"band": band, "gain4_q16": gain} for band, gain in gains4_q16.items()]
        self._post_items("gains", frame, items, on_refused)

    def telemetry(self, taps: int, taps_every: int, weights_every: int) -> None:
        """Ask for taps (bits of TAP_BASE, TAP_SIGNAL, TAP_MOTOR) and weights, every so many frames; 0 is never.

        The taps of a frame come when its motor tap is known, one or two frames later.
        """
        self._post("telemetry", {"taps": taps, "taps_every": taps_every, "weights_every": weights_every})

    def status(self, timeout_s: float = 1.0) -> dict[str, int]:
        """Return the MCU's counters: the fields of `status` and `motor_status` together."""
        self.request_status()
        end_us = self.carrier.now_us() + round(timeout_s * 1e6)
        while not (status := self.take_status()):
            self._step(end_us, "the MCU sent no status")
        return status

    def request_status(self) -> None:
        """Ask for the MCU's counters without waiting for them; `take_status` has them when they have come."""
        self._status = {}
        self._motor_status = {}
        self._post("status_request")

    def take_status(self) -> dict[str, int]:
        """Return what `request_status` has asked for, once; empty until it has come."""
        if not self._status or not self._motor_status:
            return {}
        status = {**self._status, **self._motor_status}
        self._status, self._motor_status = {}, {}
        return status

    def pump(self, wait_us: int) -> None:
        """Let at most `wait_us` pass, take what has come, keep the link alive."""
        self._send_stream()
        if self.carrier.now_us() - self._posted_us >= self._ping_us:
            self._post("ping")
        self.link.pump(wait_us)

    def flush(self, timeout_s: float = 1.0) -> None:
        """Wait until every command is acknowledged, `timeout_s` at most for the next one that is."""
        for _ in self._flushing(timeout_s, "commands were not acknowledged"):
            pass

    def close(self) -> None:
        """Close the port. It does not stop the puppet: `stop` and `kill` do."""
        self.carrier.close()

    def _flushing(self, timeout_s: float, complaint: str) -> Iterator[int]:
        """Let moments pass until every command is acknowledged; yield how many are not."""
        self._send_stream(at_once=True)
        before = end_us = 0
        while pending := self.link.pending:
            if pending != before:
                before, end_us = pending, self.carrier.now_us() + round(timeout_s * 1e6)
            self._step(end_us, complaint)
            yield self.link.pending

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
        self,
        name: str,
        frame: int,
        items: list[dict[str, int]],
        on_refused: Callable[[int, int], None] | None,
        index: str = "",
    ) -> None:
        if index and frame == formats.FRAME_NOW:
            new = {item[index] for item in items}

            def is_superseded(message: Message) -> bool:
                return message.fields["frame"] == frame and new.issuperset(item[index] for item in message.items)

            self.link.withdraw(name, is_superseded)
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
            self.weights_seen.append(self.weights)
        elif message.name == "status":
            self._status = message.fields
        elif message.name == "motor_status":
            self._motor_status = message.fields

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
