"""The board: a Raspberry Pi Pico. The only file that imports `machine`.

The link is USB-CDC, which is the board's standard input and output, and UART0 on GP0 (TX) and GP1 (RX) at 115200 baud,
both at once; answers go to where the last bytes came from. Servo pulses come from the PWM slices: 125 MHz / 40 gives
counts of 0.32 us, 62500 of them a period of exactly 20 ms. Nothing here allocates after start-up.
"""

import gc
import select
import sys
import time

import machine
import micropython
from micropython import const

_UART_BAUD = const(115200)
_LAST_PIN = const(28)
_RETURN = const(13)
_CTRL_C = const(3)
_PWM_WORD = const(0x10014000)  # address of the PWM block, 0x40050000, in words
_SLICE_WORDS = const(5)
_DIVIDER = const(640)  # 40 in the register's Q4
_TOP = const(62499)


@micropython.viper
def _start_slice(word_address: int):
    """Let a PWM slice count 20 ms periods with both outputs low."""
    slice_registers = ptr32(word_address << 2)
    slice_registers[3] = 0  # CC
    slice_registers[1] = _DIVIDER
    slice_registers[4] = _TOP
    slice_registers[2] = 0  # CTR
    slice_registers[0] = 1  # CSR: enable


@micropython.viper
def _compare(word_address: int, upper: int, counts: int):
    """Set one channel's compare value, which takes effect with the next period."""
    slice_registers = ptr32(word_address << 2)
    both = slice_registers[3]
    if upper:
        slice_registers[3] = (both & 0xFFFF) | (counts << 16)
    else:
        slice_registers[3] = ((both >> 16) << 16) | counts


@micropython.viper
def _pulses(count: int, pin: ptr8, attached: ptr8, pulse_q4us: ptr16):
    """Set the pulse widths of all attached pins. 3.125 counts a microsecond: `q4us * 25 / 128`, below 2^21."""
    d = 0
    while d < count:
        p = int(pin[d])
        if p < 29:
            if attached[p]:
                counts = (int(pulse_q4us[d]) * 25 + 64) >> 7
                slice_registers = ptr32((_PWM_WORD + ((p >> 1) & 7) * _SLICE_WORDS) << 2)
                both = slice_registers[3]
                if p & 1:
                    slice_registers[3] = (both & 0xFFFF) | (counts << 16)
                else:
                    slice_registers[3] = ((both >> 16) << 16) | counts
        d += 1


class Board:
    """The pins, the timer and the link of a Pico."""

    def __init__(self):
        micropython.kbd_intr(-1)
        self._stdin = sys.stdin.buffer
        self._stdout = sys.stdout.buffer
        rx = machine.Pin(1, pull=machine.Pin.PULL_UP)
        self._uart = machine.UART(0, _UART_BAUD, tx=machine.Pin(0), rx=rx, rxbuf=1024, txbuf=1024)
        self._to_uart = False
        self._usb_poll = select.poll()
        self._usb_poll.register(sys.stdin, select.POLLIN)
        self._usb_room = select.poll()
        self._usb_room.register(sys.stdout, select.POLLOUT)
        self._poll = select.poll()
        self._poll.register(sys.stdin, select.POLLIN)
        self._poll.register(self._uart, select.POLLIN)
        self._byte = bytearray(1)
        self._attached = bytearray(_LAST_PIN + 1)
        self._slices = bytearray(8)

    def ticks_us(self):
        """Return the microsecond timer modulo 2^30."""
        return time.ticks_us()

    def wait(self, longest_us):
        """Sleep until a byte arrives, or until less than a millisecond of `longest_us` is left."""
        if longest_us >= 2000:
            for _ in self._poll.ipoll((longest_us - 1000) // 1000):
                break

    def receive(self, buffer):
        """Read what has arrived into `buffer`, at most its length; return the number of bytes. Never waits.

        Over USB `0D 03` ends a read: if it calls for the REPL, what follows is meant for that.
        """
        count = 0
        room = len(buffer)
        byte = self._byte
        while count < room:
            ready = False
            for _ in self._usb_poll.ipoll(0):
                ready = True
            if not ready:
                break
            self._stdin.readinto(byte)
            buffer[count] = byte[0]
            count += 1
            if byte[0] == _CTRL_C and (count == 1 or buffer[count - 2] == _RETURN):
                break
        if count:
            self._to_uart = False
        elif self._uart.any():
            count = self._uart.readinto(buffer) or 0
            self._to_uart = True
        return count

    def send(self, buffer, length):
        """Send the first `length` bytes of `buffer` to where the last bytes came from.

        A host that has stopped reading USB holds the caller up once, for a second at most; what follows is dropped
        until it reads again: telemetry may be lost, and answers it will ask for again.
        """
        if self._to_uart:
            self._uart.write(buffer, length)  # type: ignore[call-arg]  # the stub lacks the length
            return
        for _ in self._usb_room.ipoll(0):
            self._stdout.write(buffer, length)

    def is_output(self, pin):
        """Return whether a servo may hang on this pin: not the UART's, not those that a Pico uses itself."""
        return 2 <= pin <= 22 or 26 <= pin <= _LAST_PIN

    def clash(self, pin, other):
        """Return whether two pins are outputs of the same PWM channel."""
        return pin & 15 == other & 15

    def attach(self, pin):
        """Give a pin to its PWM channel; it stays low until a pulse width is set."""
        number = (pin >> 1) & 7
        address = _PWM_WORD + number * _SLICE_WORDS
        if self._slices[number]:
            _compare(address, pin & 1, 0)
        else:
            _start_slice(address)
            self._slices[number] = 1
        machine.Pin(pin, machine.Pin.ALT, alt=machine.Pin.ALT_PWM)
        self._attached[pin] = 1

    def pulses(self, count, pin, pulse_q4us):
        """Set the pulse widths from the next period on: `pulse_q4us[d]` on `pin[d]` where that is attached."""
        _pulses(count, pin, self._attached, pulse_q4us)

    def release(self, pin):
        """Drive one pin low and take it from its PWM channel."""
        if self._attached[pin]:
            machine.Pin(pin, machine.Pin.OUT, value=0)
            _compare(_PWM_WORD + ((pin >> 1) & 7) * _SLICE_WORDS, pin & 1, 0)
            self._attached[pin] = 0

    def quiet(self):
        """Drive all attached pins low at once, whatever the PWM counters stand at."""
        for pin in range(_LAST_PIN + 1):
            self.release(pin)

    def heap_free(self):
        """Return the free bytes of the heap."""
        return gc.mem_free()

    def close(self):
        """Leave the board as a REPL expects it: no pulses, no UART, Ctrl-C interrupts."""
        self.quiet()
        self._uart.deinit()
        micropython.kbd_intr(3)
