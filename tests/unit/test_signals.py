"""Signals end a block once, and its clean-up is not disturbed by those that follow."""

import os
import signal

import pytest

from marotte.signals import ENDING, interruptible, uninterruptible

SIGNALS = [signal.SIGINT, *ENDING]


def send(*numbers):
    for number in numbers:
        os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", SIGNALS)
def test_signal_ends_a_block_once(number):
    before = [signal.getsignal(each) for each in SIGNALS]
    with interruptible():
        with pytest.raises(KeyboardInterrupt):
            send(number)
        send(*SIGNALS)  # as when a shell and the system both tell that a terminal is closed
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_signals_that_are_ignored_stay_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible():
            send(signal.SIGHUP)
            with pytest.raises(KeyboardInterrupt):
                send(signal.SIGTERM)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_do_not_disturb_what_must_not_be():
    before = [signal.getsignal(each) for each in SIGNALS]
    with uninterruptible():
        send(*SIGNALS)
    assert [signal.getsignal(each) for each in SIGNALS] == before
