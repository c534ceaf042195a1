"""Signals that end a program, where outputs have pulses: they end a block as Ctrl-C does, and its clean-up is not disturbed."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Signals that end a block as Ctrl-C does; SIGHUP comes when its terminal is closed, or the connection to it is lost."""


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let ENDING signals end the block as Ctrl-C does, but for those that are ignored, as `nohup` does it.

    The first of them ends it, Ctrl-C included; those that follow are ignored, so that they do not disturb its clean-up.
    """

    def interrupt(*_: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        numbers.append(signal.SIGINT)
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextlib.contextmanager
def uninterruptible() -> Iterator[None]:
    """Ignore Ctrl-C and ENDING signals in the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals = (signal.SIGINT, *ENDING)
    before = [signal.signal(number, signal.SIG_IGN) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
