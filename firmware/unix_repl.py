"""The REPL that a Pico has and MicroPython's unix port lacks: raw mode for programs, and a plain friendly one.

Input comes over the board's link; output is what is printed, which the host sends on. Ctrl-A enters raw mode, Ctrl-B
leaves it (on an empty line), Ctrl-C drops the line, Ctrl-D carries out what was sent in raw mode, and begins the
firmware anew in friendly mode or where raw mode has nothing to carry out before Ctrl-B. Raw paste mode is refused, as
programs that know it expect of those that do not.
"""

import sys

from micropython import const

_RAW_BANNER = "raw REPL; CTRL-B to exit\r\n>"
_PASTE_REQUEST = b"\x05A"
_WAIT_US = const(1000000)


class _Reset(BaseException):
    """What `machine.reset()` raises here: the REPL's end."""


class _Machine:
    """As much of the module `machine` as mpremote needs to reset an MCU."""

    @staticmethod
    def reset():
        """Begin the firmware anew."""
        raise _Reset


class Repl:
    """A REPL over a board's link."""

    def __init__(self, board):
        self._board = board
        self._byte = bytearray(1)
        self._names = {"__name__": "__main__"}
        sys.modules["machine"] = _Machine()  # type: ignore[assignment]  # all of the module that is needed

    def run(self):
        """Serve until Ctrl-D in friendly mode, or `machine.reset()`."""
        try:
            self._serve()
        except _Reset:
            pass

    def _serve(self):
        raw = False
        line = bytearray()
        print("\r\n>>> ", end="")
        while True:
            byte = self._read()
            if byte == 1 and (raw or not line):
                raw = True
                line = bytearray()
                print(_RAW_BANNER, end="")
            elif byte == 2 and (raw or not line):
                raw = False
                line = bytearray()
                print("\r\nMicroPython on a PC, Marotte\r\n>>> ", end="")
            elif byte == 3:
                line = bytearray()
                if not raw:
                    print("\r\n>>> ", end="")
            elif raw:
                line = self._raw(byte, line)
            elif byte == 4 and not line:
                print("\r\nMPY: soft reboot\r\n", end="")
                return
            else:
                line = self._friendly(byte, line)

    def _read(self):
        while not self._board.receive(self._byte):
            self._board.wait(_WAIT_US)
        return self._byte[0]

    def _raw(self, byte, line):
        if byte == 4:
            if not line:
                print("OK\r\nMPY: soft reboot\r\n" + _RAW_BANNER, end="")
                return line
            print("OK", end="")
            error = self._run(line, "exec")
            print("\x04", end="")
            if error:
                sys.print_exception(error, sys.stdout)
            print("\x04>", end="")
            return bytearray()
        line.append(byte)
        if line == _PASTE_REQUEST + b"\x01":
            print("R\x00", end="")
            return bytearray()
        return line

    def _friendly(self, byte, line):
        if byte == 13:
            print("\r\n", end="")
            error = self._run(line, "single") if line else None
            if error:
                sys.print_exception(error, sys.stdout)
            print(">>> ", end="")
            return bytearray()
        if byte in (8, 127):
            if line:
                print("\b \b", end="")
            return line[:-1]
        if byte >= 32:
            line.append(byte)
            print(chr(byte), end="")
        return line

    def _run(self, source, mode):
        """Carry out source text; return the exception that it raised, or None."""
        try:
            exec(compile(bytes(source).decode(), "<stdin>", mode), self._names)
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            return error
        return None
