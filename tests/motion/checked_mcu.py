"""The firmware under CPython as an emulated MCU, with every integer of kernels and of what runs per frame and tick checked.

It is the PC's emulated MCU, with another process: a thread that runs the virtual board and the main loop in checked integers.
"""

import io
import os
import threading
import types

from marotte.mcu.unix import UnixMcu
from marotte.mcu.unix_process import UnixProcess
from tests.checked import load_checked

TICKS_MODULUS = 1 << 30


def methods(name, *functions):
    """Return the full names of a class's methods."""
    return [f"{name}.{function}" for function in functions]


# fmt: off
SMALL_INT_FUNCTIONS = (
    "ticks_diff", "seal", "is_sealed",
    *methods("FrameClock", "start", "until_us", "begin"),
    *methods("Cues", "clear", "put", "apply", "renumber"),
    *methods(
        "Actions", "compute_phases", "follow_tempos", "end_gestures", "enter", "warp", "_phases", "_nominal", "_place"
    ),
    *methods("Blinks", "enter", "evaluate", "exchange"),
    *methods("Programs", "evaluate", "add"),
    *methods("Kalman", "step", "is_moving"),
    *methods("SignalProcessing", "glide", "process", "bypass", "note", "follow"),
    *methods("Outlook", "take", "write", "sketch", "_advance_phases", "_first_end", "_end_gestures"),
    *methods("Foresight", "evaluate"),
    *methods("Budget", "weigh", "news_us", "frames"),
    *methods("Rings", "read", "write", "write_block", "fill", "smooth", "bend", "split", "exchange"),
    *methods(
        "Future", "has_news", "before_news", "advance", "work", "finish", "relent", "need_us", "expect_news", "sketch_before",
        "exchange", "_sketch", "_recall", "_begin", "_differ", "_bend_near", "_bend_far", "_bend", "_compute_some", "_wanted",
        "_compute",
    ),
    *methods("Inbox", "look", "next", "is_calling", "_put"),
    *methods("Exchange", "carry_over", "_carry_synthesis", "_swap"),
    *methods(
        "Puppet", "start", "stop", "prepare", "step", "expects_news", "_synthesise", "_rest", "_work", "_has_heard", "_expect",
        "_has_time",
    ),
    *methods(
        "Motor", "exchange", "start", "stand", "put", "heard", "arm", "kill", "limit", "attach", "detach", "derive",
        "attend", "_rearrange", "_take_over", "_tick", "_steps", "_tap", "_stand", "_hold_unattached",
    ),
    *methods("Ring", "put", "rearrange"),
    *methods(
        "Trajectory", "hold", "stand_one", "prepare", "start", "put", "rearrange", "advance", "derive", "_next"
    ),
    *methods("Character", "stand", "rearrange", "respond"),
    *methods("Feedback", "pause", "tick", "_begin", "measured", "start", "forgive"),
    *methods(
        "Guards", "arm", "disarm", "attend", "_outputs", "_kept", "_queue", "_attach_next", "_attach", "_detach"
    ),
    *methods("Drivers", "load", "attach", "release", "write", "flush", "quiet", "attend"),
    *methods("PinsDriver", "load", "attach", "release", "write", "quiet"),
    *methods("BridgeDriver", "load", "attach", "release", "write", "_write", "quiet"),
    *methods("Pca9685Driver", "load", "attach", "release", "flush", "attend", "quiet", "_enable", "_switch", "_wanted"),
    *methods("_Chip", "load", "_take_channels", "attach", "release", "quiet", "flush", "attend", "_set_up", "gone", "_transfer"),
    *methods("Link", "poll", "report", "send", "_packet", "_answer", "_drop"),
    *methods("Commands", "carry_out", "_queue", "_refuse"),
    *methods(
        "Commands", "_on_weight_targets", "_on_live_targets", "_on_tempo", "_on_telemetry", "_on_start", "_on_stop", "_on_ping",
        "_on_arm", "_on_kill", "_on_hello", "_on_calibrate", "_on_limit",
    ),
    "_half", "_word", "_scale_q21", "_fold",
    *methods("Tables", "bad_limit", "_bad_limit", "limit", "bad_calibration", "_bad_calibration", "calibrate"),
    *methods("Telemetry", "report", "_report_taps", "_send_taps", "_pack_frame"),
)
"""What runs while a puppet plays: a larger integer would allocate on a 32-bit port."""
# fmt: on


class CheckedMcu(UnixMcu):
    """Its timer stands `before_wrap_us` before its wrap at power on, and at each reset."""

    def __init__(self, before_wrap_us=2_000_000):
        self._start_ticks = TICKS_MODULUS - before_wrap_us
        super().__init__(binary=__file__)
        self.kind = "checked"

    def _start(self):
        return CheckedProcess(self._start_ticks, f"{self._ram.name}/kept", self._resets)


class CheckedProcess(UnixProcess):
    """A thread that performs as `firmware/unix_main.py` does, until it is reset; nothing calls for the REPL."""

    def __init__(self, start_ticks, kept, resets):
        self._error = None
        command_read, self._commands = os.pipe()
        self._records, record_write = os.pipe()
        self._buffer = b""
        arguments = start_ticks, command_read, record_write, kept, resets
        self._thread = threading.Thread(target=self._run, args=arguments, daemon=True)
        self._thread.start()
        for _ in self.records():
            pass

    def printed(self):
        return b""

    def close(self):
        for descriptor in (self._commands, self._records):
            if descriptor >= 0:
                os.close(descriptor)
        self._commands = self._records = -1
        self._thread.join()

    def _run(self, start_ticks, command_read, record_write, kept, resets):
        memory = types.SimpleNamespace(collect=lambda: 0, mem_free=lambda: 0)
        try:
            with open(command_read, "rb") as commands, _Records(record_write) as records:  # noqa: PTH123
                modules = {"gc": memory}
                perform = load_checked("firmware/main.py", modules, bytecode=SMALL_INT_FUNCTIONS).perform
                board = load_checked("firmware/board_unix.py", modules).Board(commands, records, kept, resets)
                board._start_us = start_ticks
                perform(board)
                raise AssertionError("nothing here calls for the REPL")
        except (SystemExit, BrokenPipeError):
            pass  # it is closed
        except BaseException as error:
            self._error = error

    def _failed(self, what):
        self.close()
        return self._error or AssertionError(what)


class _Records(io.FileIO):
    """A file whose `write` takes a length, as on MicroPython."""

    def __init__(self, descriptor):
        super().__init__(descriptor, "wb")

    def write(self, data, length=None):
        rest = memoryview(data)[:length]
        while rest:
            rest = rest[super().write(rest) :]
