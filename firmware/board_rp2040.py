"""The board: a Raspberry Pi Pico. The only file that imports `machine`.

The link is USB-CDC, which is the board's standard input and output, and UART0 on GP0 (TX) and GP1 (RX) at 115200 baud,
both at once; answers go to where the last bytes came from. Motor ticks come from a hardware timer, in interrupts. Pulses
come from the PWM slices: 125 MHz / 40 gives servos counts of 0.32 us, so that every multiple of 8 us is a whole number of
them; bridges count at 125 MHz. Registers are set by kernels, as the RP2040's data sheet has them; what the motor tick calls
allocates nothing.

A slice takes compare and top over when its counter wraps, or at once while it stands (data sheet, 4.5.2.3). Its other channel may
be at work, so a channel is cleared by the register's atomic alias, and a pin that is given to a running slice gets its
first pulse a write later, when the slice has certainly taken the 0 over.
"""

import gc
import select
import sys
import time
from array import array

import machine
import micropython
from micropython import const

from firmware.clock import ticks_diff

_UART_BAUD = const(115200)
_PINS = const(30)
_LAST_PIN = const(28)

# What a pin does, by pin.
_OFF = const(0)
_PULSES = const(1)
_CONNECTS = const(2)  # with the next write
_CLEARS = const(3)  # the next write only lets the slice take the 0 over

# Addresses of registers in words, because viper has no literals as large as they are.
_PWM = const(0x10014000)
_PWM_CLEAR = const(0x10014C00)  # the same registers: a bit written as 1 is cleared
_SLICE_WORDS = const(5)  # CSR, DIV, CTR, CC, TOP
_CONTROLS = const(0x10005001)  # IO_BANK0: control of pin 0, two words for each
_PADS = const(0x10007001)  # PADS_BANK0: pad of pin 0, one word for each
_SIO = const(0x34000000)
_TIMER = const(0x10015000)
_ADC = const(0x10013000)
_WATCHDOG = const(0x10016000)
_PSM = const(0x10004000)
_KEPT = const(0x8010000)
_USB_IN = const(0x14040024)  # buffer control of endpoint 2 to the host, which is the serial port's

_DIVIDER_SERVO = const(640)  # 40, in the register's Q4
_DIVIDER_BRIDGE = const(16)
_BRIDGE_US = const(50)
_BRIDGE_COUNTS = const(6250)
_ALARM_SLACK_US = const(300)
_SLEEP_US = const(1200)
_WATCHDOG_MAX_MS = const(8000)
_USB_BYTES = const(256)  # what MicroPython's buffer to the host holds
_USB_ANSWERS = const(64)  # of that, what telemetry leaves to answers
_USB_LOOKS = const(8)  # at a buffer that is being sent; a packet of USB takes 50 us
_UART_CHARACTER_US = const(87)
_UART_US = const(87000)  # what the buffer of the UART holds, as time
_UART_TELEMETRY_US = const(26000)  # of that, what telemetry may take: an answer waits behind it
_BURST_BITS = const(640)  # the longest I2C transfer, 66 bytes with their acknowledgements, and a little
_POSES = const(1)  # words that a reset leaves as they are, after the tag
_RESETS = const(17)
_GUARDED = const(18)


@micropython.viper
def _start_slice(number: int, divider_q4: int, counts: int, at: int):
    """Let a PWM slice count periods of so many counts, from the count `at` on, both outputs low."""
    registers = ptr32((_PWM + number * _SLICE_WORDS) << 2)
    registers[0] = 0  # CSR: stand, so that the others are taken over at once
    registers[1] = divider_q4
    registers[2] = at
    registers[3] = 0
    registers[4] = counts - 1
    registers[0] = 1


@micropython.viper
def _clear(pin: int):
    """Set the compare value of a pin's channel to 0."""
    ptr32((_PWM_CLEAR + ((pin >> 1) & 7) * _SLICE_WORDS) << 2)[3] = 0xFFFF << ((pin & 1) << 4)


@micropython.viper
def _drive(pin: int, level: int):
    """Make a pin a plain output of this level, at once."""
    base = _SIO
    sio = ptr32(base << 2)
    bit = 1 << pin
    if level:
        sio[5] = bit  # GPIO_OUT_SET
    else:
        sio[6] = bit  # GPIO_OUT_CLR
    sio[9] = bit  # GPIO_OE_SET
    ptr32((_PADS + pin) << 2)[0] = 0x56  # as after a reset: it may have been an analogue input, which has no output
    ptr32((_CONTROLS + (pin << 1)) << 2)[0] = 5  # SIO


@micropython.viper
def _quiet(count: int, use: ptr8):
    """Drive all pins below `count` that have a use low, and clear their channels."""
    base = _SIO
    sio = ptr32(base << 2)
    p = 0
    while p < count:
        if use[p]:
            use[p] = _OFF
            sio[6] = 1 << p
            sio[9] = 1 << p
            ptr32((_CONTROLS + (p << 1)) << 2)[0] = 5
            ptr32((_PWM_CLEAR + ((p >> 1) & 7) * _SLICE_WORDS) << 2)[3] = 0xFFFF << ((p & 1) << 4)
        p += 1


@micropython.viper
def _compare(pin: int, duty_q16: int, use: ptr8):
    """Set a channel to its part of 6250 counts, from its next period on; connect the pin if it is time.

    Bits: 65536 times 6250 stays below 2^29.
    """
    now = int(use[pin])
    counts = (duty_q16 * _BRIDGE_COUNTS + 0x8000) >> 16
    if now == _CLEARS:
        use[pin] = _CONNECTS
    elif now:
        registers = ptr32((_PWM + ((pin >> 1) & 7) * _SLICE_WORDS) << 2)
        both = registers[3]
        if pin & 1:
            registers[3] = (both & 0xFFFF) | (counts << 16)
        else:
            registers[3] = (((both >> 16) & 0xFFFF) << 16) | counts
        if now == _CONNECTS:
            use[pin] = _PULSES
            ptr32((_CONTROLS + (pin << 1)) << 2)[0] = 4  # PWM


@micropython.viper
def _pulses(count: int, pin: ptr8, due: int, pulse_q18us: ptr32, use: ptr8):
    """Set the pulse widths of the DOFs below `count` that are due and have a pin, and connect pins that wait for it.

    3.125 counts a microsecond, the nearest count, and at least 200 us of the period stay low. Bits: a width of 3000 us is
    below 2^30 in Q18; its upper bits times 25 stay below 2^31.
    """
    d = 0
    while d < count:
        p = int(pin[d])
        if p < 30:
            if (due >> d) & 1:
                now = int(use[p])
                if now == _CLEARS:
                    use[p] = _CONNECTS
                elif now:
                    counts = ((int(pulse_q18us[d]) >> 4) * 25 + 0x10000) >> 17
                    registers = ptr32((_PWM + ((p >> 1) & 7) * _SLICE_WORDS) << 2)
                    longest = int(registers[4]) - 624
                    if counts > longest:
                        counts = longest
                    both = int(registers[3])
                    if p & 1:
                        registers[3] = (both & 0xFFFF) | (counts << 16)
                    else:
                        registers[3] = (((both >> 16) & 0xFFFF) << 16) | counts
                    if now == _CONNECTS:
                        use[p] = _PULSES
                        ptr32((_CONTROLS + (p << 1)) << 2)[0] = 4  # PWM
        d += 1


@micropython.viper
def _level(pin: int) -> int:
    """Return the level at a pin."""
    base = _SIO
    return (int(ptr32(base << 2)[1]) >> pin) & 1


@micropython.viper
def _convert(pin: int):
    """Begin to measure the voltage at a pin, 26 to 28, which is that and nothing else from now on."""
    base = _ADC
    ptr32((_CONTROLS + (pin << 1)) << 2)[0] = 31  # no function
    ptr32((_PADS + pin) << 2)[0] = 0x80  # output and input off, no pulls
    ptr32(base << 2)[0] = ((pin - 26) << 12) | 5  # CS: the input, once, on


@micropython.viper
def _converted() -> int:
    """Return the last conversion as a ratio to the supply: 4095 is 32768. Bits: below 2^16."""
    base = _ADC
    raw = int(ptr32(base << 2)[1]) & 0xFFF
    return (raw << 3) + ((raw + 256) >> 9)


@micropython.viper
def _later(ticks_us: int, us: int) -> int:
    """Return the instant `us` after another, modulo 2^30: no sum gets so large that it needs memory."""
    return (ticks_us + us) & 0x3FFFFFFF


@micropython.viper
def _alarm_us() -> int:
    """Return the instant of the timer's alarm 3, MicroPython's, modulo 2^30."""
    base = _TIMER
    return int(ptr32(base << 2)[7]) & 0x3FFFFFFF


@micropython.viper
def _read(ready, read, single, buffer: ptr8, room: int) -> int:
    """Read what has come over USB, up to `0D 03`; return the number of bytes.

    One at a time: `read` waits for as many as are asked for, and `ready(0)` only tells whether there is one.
    """
    byte = ptr8(single)
    count = 0
    before = 13
    while count < room:
        is_ready = 0
        for _ in ready(0):
            is_ready = 1
        if is_ready == 0:
            return count
        read(single)
        now = int(byte[0])
        buffer[count] = now
        count += 1
        if now == 3:
            if before == 13:
                return count
        before = now
    return count


@micropython.viper
def _usb_is_idle() -> int:
    """Return whether the endpoint to the host has nothing left that the host has not taken."""
    base = _USB_IN
    return 0 if int(ptr32(base << 2)[0]) & 0x4000400 else 1  # AVAILABLE of both halves


@micropython.viper
def _guard(on: int, load: int):
    """Switch the watchdog on or off. It resets all but the oscillators."""
    base = _WATCHDOG
    enable = 1
    enable = enable << 30
    ptr32((base + 0xC00) << 2)[0] = enable  # CTRL, cleared
    if on:
        psm = _PSM
        ptr32(psm << 2)[2] = 0x1FFFC  # WDSEL
        watchdog = ptr32(base << 2)
        watchdog[7] = 0  # SCRATCH4: no address to boot from
        watchdog[1] = load
        ptr32((base + 0x800) << 2)[0] = enable  # CTRL, set


@micropython.viper
def _feed(load: int):
    """Set the watchdog's counter back."""
    base = _WATCHDOG
    ptr32(base << 2)[1] = load


@micropython.viper
def _bitten() -> int:
    """Return whether the watchdog's time has run out before this start."""
    base = _WATCHDOG
    return int(ptr32(base << 2)[2]) & 1


@micropython.viper
def _keep(place: int, value: int):
    """Keep 16 bits where a reset leaves them, with their complement."""
    ptr32((_KEPT + place) << 2)[0] = ((value ^ 0xFFFF) << 16) | value


@micropython.viper
def _kept(place: int) -> int:
    """Return 16 bits that were kept, or -1 if they are damaged."""
    word = int(ptr32((_KEPT + place) << 2)[0])
    if ((word ^ (word >> 16)) & 0xFFFF) == 0xFFFF:
        return word & 0xFFFF
    return -1


@micropython.viper
def _keep_pose(count: int, position_q24: ptr32, tag: int):
    """Keep `count` positions, rounded to Q15, under a tag. A reset in between leaves words that fit each other."""
    base = _KEPT
    kept = ptr32(base << 2)
    if int(kept[0]) != tag:
        kept[0] = 0
    d = 0
    while d < count:
        value_q15 = (int(position_q24[d]) + 256) >> 9
        kept[1 + d] = ((value_q15 ^ 0xFFFF) << 16) | value_q15
        d += 1
    kept[0] = tag


@micropython.viper
def _tag() -> int:
    """Return the tag under which the pose was kept."""
    base = _KEPT
    return int(ptr32(base << 2)[0])


def _nothing():
    """Be the handler of ticks that nobody wants."""


class Board:
    """The pins, the timer and the link of a Pico."""

    def __init__(self):
        micropython.kbd_intr(-1)
        self._usb_read = sys.stdin.buffer.readinto  # bound once: binding allocates
        self._stdout = sys.stdout.buffer
        rx = machine.Pin(1, pull=machine.Pin.PULL_UP)
        self._uart = machine.UART(0, _UART_BAUD, tx=machine.Pin(0), rx=rx, rxbuf=1024, txbuf=1024)
        self._to_uart = False
        self._line_us = 0  # when the UART will have sent all that it has been given
        self._usb_bytes = _USB_BYTES  # at most so many of the buffer's have not been sent
        usb_poll = select.poll()
        usb_poll.register(sys.stdin, select.POLLIN)
        self._usb_ready = usb_poll.ipoll
        self._usb_room = select.poll()
        self._usb_room.register(sys.stdout, select.POLLOUT)
        self._poll = select.poll()
        self._poll.register(sys.stdin, select.POLLIN)
        for poll in (usb_poll, self._usb_room, self._poll):  # the first event allocates what tells of all
            poll.register(self._uart, select.POLLOUT)
            for _ in poll.ipoll(0):
                pass
            poll.unregister(self._uart)
        self._poll.register(self._uart, select.POLLIN)
        self._byte = bytearray(1)
        self._timer = machine.Timer(-1)
        self._on_timer = self._tick
        self._handler = _nothing
        self._period_us = 0
        self._due_us = 0
        self._settled = False  # whether that is exact
        self._ticks = 0
        self._use = bytearray(_PINS)
        self._sliced = bytearray(_PINS)  # whether the slice has had pulses for this pin since it was started
        self._slice_us = array("H", bytes(16))  # periods of the slices that run, 0 for those that are to be started
        self._buses = bytearray(_PINS)  # the pins of I2C
        self._load = 0
        self._tag = 0
        machine.ADC(0)  # wakes the converter up; it is the only thing that this does to pin 26
        if _bitten() and _kept(_GUARDED) == 1:
            _keep(_RESETS, min(self.watchdog_resets() + 1, 0xFFFF))
        _keep(_GUARDED, 0)

    # --- time

    def ticks_us(self):
        """Return the microsecond timer modulo 2^30."""
        return time.ticks_us()

    def wait(self, longest_us):
        """Sleep until a byte arrives or a motor tick has run, or until little more than a millisecond of `longest_us` is left."""
        ticks = self._ticks
        end_us = _later(time.ticks_us(), longest_us)
        while ticks == self._ticks and ticks_diff(end_us, time.ticks_us()) > _SLEEP_US:
            for _ in self._poll.ipoll(0):
                return
            machine.idle()  # until an interrupt, for a millisecond at most

    def start_ticks(self, period_us, handler):
        """Call `handler` each `period_us` from now on, in interrupts, the first time in one period.

        Ticks keep to their nominal instants, whatever one of them comes late by; none is left out. Periods of servos begin
        anew with the pins that are attached next.
        """
        self.stop_ticks()
        for number in range(8):
            self._slice_us[number] = 0
        self._handler = handler
        self._period_us = period_us
        self._due_us = _later(time.ticks_us(), period_us)
        self._settled = False
        # fmt: off
        self._timer.init(  # type: ignore[call-overload]  # the stub knows no period in microseconds
            mode=machine.Timer.PERIODIC, period=period_us, tick_hz=1000000, hard=True, callback=self._on_timer
        )
        # fmt: on

    def stop_ticks(self):
        """Call the handler no more."""
        self._timer.deinit()
        self._handler = _nothing

    def tick_due_us(self):
        """Return the nominal instant of the next tick, modulo 2^30; asked in the handler, of the one after."""
        if not self._settled:
            self._settle()
        return self._due_us

    def _settle(self):
        """Replace the guessed instant of the first tick by that for which the timer is set, once it is.

        The guess is early by what MicroPython takes to set the timer; anything else is somebody else's alarm.
        """
        state = machine.disable_irq()
        alarm_us = _alarm_us()
        if 0 <= ticks_diff(alarm_us, self._due_us) < _ALARM_SLACK_US:
            self._due_us = alarm_us
            self._settled = True
        machine.enable_irq(state)

    def _tick(self, _timer):
        if not self._settled:
            self._settle()
            self._settled = True
        self._due_us = _later(self._due_us, self._period_us)
        self._ticks = (self._ticks + 1) & 0xFFFF
        self._handler()

    def lock(self):
        """Keep ticks away, for less than 100 us; return what `unlock` needs."""
        return machine.disable_irq()

    def unlock(self, state):
        """Let ticks come again."""
        machine.enable_irq(state)

    # --- the link

    def receive(self, buffer):
        """Read what has arrived into `buffer`, at most its length; return the number of bytes. Never waits.

        Over USB `0D 03` ends a read: if it calls for the REPL, what follows is meant for that.
        """
        room = len(buffer)
        count = _read(self._usb_ready, self._usb_read, self._byte, buffer, room)
        if count:
            self._to_uart = False
        else:
            ready = self._uart.any()
            if ready:  # no more than that, as it would wait for a millisecond whether another byte follows
                count = self._uart.readinto(buffer, min(ready, room)) or 0
                self._to_uart = True
        return count

    def send(self, buffer, length, is_telemetry=False):
        """Send the first `length` bytes of `buffer`, at most 252, to where the last bytes came from, or drop them.

        What has not all its room now is dropped, as MicroPython would wait for it, over USB for half a second when the host does
        not read: telemetry may be lost, and answers the host will ask for again. Telemetry leaves some room for those.
        """
        if self._to_uart:
            self._send_uart(buffer, length, _UART_TELEMETRY_US if is_telemetry else _UART_US)
        else:
            self._send_usb(buffer, length, _USB_BYTES - _USB_ANSWERS if is_telemetry else _USB_BYTES)

    def _send_uart(self, buffer, length, most_us):
        now_us = time.ticks_us()
        ahead_us = ticks_diff(self._line_us, now_us)
        if not 0 < ahead_us <= _UART_US:
            ahead_us = 0
        ahead_us += length * _UART_CHARACTER_US
        if ahead_us <= most_us:
            self._line_us = _later(now_us, ahead_us)
            self._uart.write(buffer, length)  # type: ignore[call-arg]  # the stub lacks the length

    def _send_usb(self, buffer, length, most):
        looks = _USB_LOOKS
        while self._usb_bytes and self._usb_bytes + length > most:
            if looks == 0:
                return
            looks -= 1
            # With an idle endpoint before and behind a turn of the USB stack, which would have gone on, the buffer is empty.
            was_idle = _usb_is_idle()
            for _ in self._usb_room.ipoll(0):
                pass
            if was_idle and _usb_is_idle():
                self._usb_bytes = 0
        self._usb_bytes += length
        self._stdout.write(buffer, length)

    # --- pins

    def is_output(self, pin):
        """Return whether something may hang on this pin: not the UART's, not those that a Pico uses itself."""
        return 2 <= pin <= 22 or 26 <= pin <= _LAST_PIN

    def clash(self, pin, other):
        """Return whether two pins are outputs of the same PWM channel."""
        return pin & 15 == other & 15

    def same_slice(self, pin, other):
        """Return whether two pins belong to the same PWM slice and so have one period."""
        return (pin >> 1) & 7 == (other >> 1) & 7

    def input_pullup(self, pin):
        """Make a pin an input that is high if nobody drives it."""
        machine.Pin(pin, machine.Pin.IN, machine.Pin.PULL_UP)

    def level(self, pin):
        """Return the level at a pin, 0 or 1."""
        return _level(pin)

    def drive(self, pin, level):
        """Make a pin an output of this level, at once."""
        _drive(pin, level)

    def pin_low(self, pin):
        """Drive a pin low, at once, and take it from its PWM slice."""
        _drive(pin, 0)
        if self._use[pin]:
            self._use[pin] = _OFF
            _clear(pin)

    def quiet(self):
        """Drive all PWM pins low, at once, whatever the counters stand at."""
        _quiet(_PINS, self._use)

    def servo_attach(self, pin, period_us, until_wrap_us):
        """Give a pin to its PWM slice: periods of `period_us`, one of which begins in `until_wrap_us`. No pulse yet.

        A slice that runs for another pin goes on as it is; `check_output` has made sure that the periods are the same.
        """
        counts = period_us * 25 >> 3
        at = counts - (until_wrap_us % period_us * 25 >> 3)
        self._attach(pin, period_us, _DIVIDER_SERVO, counts, at if at < counts else 0)

    def servo_end(self, pin):
        """Give a pin no more pulses, from its next period on."""
        _clear(pin)

    def bridge_attach(self, pin):
        """Give a pin to its PWM slice at 20 kHz, low."""
        self._attach(pin, _BRIDGE_US, _DIVIDER_BRIDGE, _BRIDGE_COUNTS, 0)

    def _attach(self, pin, period_us, divider_q4, counts, at):
        if not self._use[pin]:
            _drive(pin, 0)
        number = (pin >> 1) & 7
        if self._slice_us[number] != period_us or not self._shared(pin):
            self._slice_us[number] = period_us
            for other in range(number << 1, _PINS, 16):
                self._sliced[other] = self._sliced[other + 1] = 0
            _start_slice(number, divider_q4, counts, at)
            self._use[pin] = _CONNECTS
        else:
            _clear(pin)
            self._use[pin] = _CLEARS if self._sliced[pin] else _CONNECTS
        self._sliced[pin] = 1

    def _shared(self, pin):
        """Return whether another pin has pulses from the slice of this one."""
        number = (pin >> 1) & 7
        for other in range(number << 1, _PINS, 16):
            if (self._use[other] and other != pin) or (self._use[other + 1] and other + 1 != pin):
                return True
        return False

    def servo_write(self, count, pin, due, pulse_q18us):
        """Set `pulse_q18us[d]` at `pin[d]`, from its next period on, for each `d` below `count` whose bit is set in `due`."""
        _pulses(count, pin, due, pulse_q18us, self._use)

    def bridge_write(self, pin, duty_q16):
        """Let a pin be high for a part of each 50 us, 65536 being all of it."""
        _compare(pin, duty_q16, self._use)

    # --- analogue inputs and I2C

    def adc_start(self, pin):
        """Begin to measure the voltage at a pin, 26 to 28; it takes 2 us."""
        _convert(pin)

    def adc_read(self):
        """Return what was measured last, 32768 being the supply."""
        return _converted()

    def i2c(self, sda, scl, baud_hz):
        """Return the I2C bus at two pins, set up anew, after freeing it from a device that holds it.

        `writeto(address, data)` returns how many bytes have arrived. It raises OSError if the device is not there, or if it
        takes half as long again as the longest burst should, and half a millisecond.
        """
        self._free_bus(sda, scl)
        self._buses[sda] = self._buses[scl] = 1
        timeout_us = 500 + _BURST_BITS * 1500 // (baud_hz // 1000)
        # fmt: off
        return machine.I2C(
            (sda >> 1) & 1, sda=machine.Pin(sda), scl=machine.Pin(scl), freq=baud_hz, timeout=timeout_us
        )
        # fmt: on

    def _free_bus(self, sda, scl):
        """Clock out what a device still has to say if it holds SDA low since a transfer was broken off, then a STOP.

        See the I2C-bus specification, 3.1.16.
        """
        data = machine.Pin(sda, machine.Pin.IN, machine.Pin.PULL_UP)
        if data.value():
            return
        clock = machine.Pin(scl, machine.Pin.OPEN_DRAIN, machine.Pin.PULL_UP, value=1)
        for _ in range(9):
            clock.value(0)
            time.sleep_us(5)
            clock.value(1)
            time.sleep_us(5)
            if data.value():
                break
        data.init(machine.Pin.OPEN_DRAIN, machine.Pin.PULL_UP, value=0)
        time.sleep_us(5)
        data.value(1)
        time.sleep_us(5)

    # --- the watchdog, and what a reset leaves

    def watchdog(self, timeout_ms):
        """Reset the MCU if `feed` is not called for so long, 8 s at most."""
        # The counter is decremented twice in a microsecond (RP2040-E1).
        self._load = min(timeout_ms, _WATCHDOG_MAX_MS) * 2000
        _keep(_GUARDED, 1)
        _guard(1, self._load)

    def feed(self):
        """Tell the watchdog that all is well."""
        _feed(self._load)

    def watchdog_off(self):
        """Let the watchdog sleep."""
        _guard(0, 0)
        _keep(_GUARDED, 0)

    def watchdog_resets(self):
        """Return how often the watchdog has reset the MCU since power on."""
        return max(_kept(_RESETS), 0)

    def keep_pose(self, dofs, position_q24):
        """Keep a pose where a reset leaves it, to Q15, under the tag that `kept_pose` was last called with.

        Before it was called, what a reset has left is not touched.
        """
        if self._tag:
            _keep_pose(dofs, position_q24, self._tag)

    def kept_pose(self, dofs, position_q24, tag):
        """Read the pose that was kept under a tag, 1 to 2^30 - 1; return whether there was one. Poses are now kept under it."""
        self._tag = tag
        if _tag() != tag:
            return False
        for d in range(dofs):
            if not 0 <= _kept(_POSES + d) <= 0x8000:
                return False
        for d in range(dofs):
            position_q24[d] = _kept(_POSES + d) << 9
        return True

    def heap_free(self):
        """Return the free bytes of the heap."""
        return gc.mem_free()

    def close(self):
        """Leave the board as a REPL expects it: no ticks, no watchdog, no pulses, no UART; Ctrl-C interrupts."""
        self.stop_ticks()
        self.watchdog_off()
        self.quiet()
        for pin in range(_PINS):
            if self._buses[pin]:
                machine.Pin(pin, machine.Pin.IN, None)
        self._uart.deinit()
        micropython.kbd_intr(3)
