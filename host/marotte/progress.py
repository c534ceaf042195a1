"""Say on standard error what a long step is doing and how long it has taken."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

TERMINAL_PERIOD_S = 0.2
PLAIN_PERIOD_S = 20.0
_SPINNER = "|/-\\"
_steps: list[str] = []
"""The steps under way, each within the one before; only the innermost shows itself."""


def say(text: str) -> None:
    """Print one line of progress."""
    print(f"marotte: {text}", file=sys.stderr, flush=True)


@contextmanager
def doing(what: str, about_s: float | None = None) -> Iterator[None]:
    """Show that `what` is under way while the block runs, and its time at the end.

    On a terminal one line with a spinner is kept up to date; elsewhere (a log, CI) a line is printed at the start, one
    every 20 s, and one at the end. `about_s` is the time that a slow machine takes, in seconds.
    """
    promise = f" (about {about_s:.0f} s)" if about_s else ""
    on_terminal = sys.stderr.isatty()
    start_s = time.monotonic()
    depth = len(_steps)
    finished = threading.Event()

    def tick() -> None:
        count = 0
        while not finished.wait(TERMINAL_PERIOD_S if on_terminal else PLAIN_PERIOD_S):
            elapsed_s = time.monotonic() - start_s
            if _steps[depth + 1 :]:
                continue
            if on_terminal:
                spinner = _SPINNER[count % len(_SPINNER)]
                sys.stderr.write(f"\r{spinner} {what}{promise}: {elapsed_s:.0f} s\x1b[K")
                sys.stderr.flush()
            else:
                say(f"{what}: {elapsed_s:.0f} s so far")
            count += 1

    if not on_terminal:
        say(f"{what}{promise} ...")
    _steps.append(what)
    ticker = threading.Thread(target=tick, daemon=True)
    ticker.start()
    outcome = "stopped after"
    try:
        yield
        outcome = "done in"
    except Exception:
        outcome = "failed after"
        raise
    finally:
        finished.set()
        ticker.join()
        _steps.pop()
        if on_terminal:
            sys.stderr.write("\r\x1b[K")
        say(f"{what}: {outcome} {time.monotonic() - start_s:.1f} s")
