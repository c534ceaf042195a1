"""Drivers of outputs on a board that only remembers: what they drive when, what they refuse, and buses that fail."""

import itertools
from fractions import Fraction
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from shared.formats import DRIVER_BRIDGE, DRIVER_PCA9685, DRIVER_PINS, NO_DRIVER, NO_PIN
from tests.checked import load_checked
from tests.kernels.values import halves, integers, words

DRIVERS = load_checked("firmware/drivers.py", bytecode=("BridgeDriver._write", "BridgeDriver.write", "_Chip.flush"))
BRIDGE = load_checked("firmware/driver_bridge.py")
PCA9685 = load_checked("firmware/driver_pca9685.py")

STOP_Q24 = 0x800000
DOFS = formats.DOFS_MAX
CHIP = (4, 5, 0x40, 6, 400, 25000)
MODE1, MODE2, PRE_SCALE, LED0, ALL_LED_OFF_H = 0x00, 0x01, 0xFE, 0x06, 0xFD
SLEEP, AUTO_INCREMENT, RESTART = 0x10, 0x20, 0x80

levels_q24 = integers(0, 1 << 24, STOP_Q24, STOP_Q24 - 1, STOP_Q24 + 1, STOP_Q24 - 64, STOP_Q24 + 64)
pulses_q18us = integers(formats.PULSE_MIN_US << 18, formats.PULSE_MAX_US << 18)


class Chip:
    """A PCA9685's registers, as its data sheet says: the prescaler can be set only while it sleeps."""

    def __init__(self):
        self.power_up()
        self.present = True
        self.transfers = 0

    def power_up(self):
        self.register = bytearray(256)
        self.register[MODE1] = 0x11
        self.register[MODE2] = 0x04
        self.register[PRE_SCALE] = 0x1E
        for channel in range(16):
            self.register[LED0 + 4 * channel + 3] = 0x10

    def write(self, data):
        self.transfers += 1
        at = data[0]
        for byte in data[1:]:
            if at == PRE_SCALE and not self.register[MODE1] & SLEEP:
                raise AssertionError("the prescaler is locked while the chip is awake")
            if at == MODE1:
                byte &= ~RESTART
            if at == ALL_LED_OFF_H:
                for channel in range(16):
                    self.register[LED0 + 4 * channel + 3] = byte
            self.register[at] = byte
            if self.register[MODE1] & AUTO_INCREMENT:
                at += 1

    def counts(self, channel):
        """Return how long a channel is high, in counts; 0 if it is off for good."""
        on_low, on_high, off_low, off_high = self.register[LED0 + 4 * channel : LED0 + 4 * channel + 4]
        assert (on_low, on_high) == (0, 0)
        return 0 if off_high & 0x10 else off_low | off_high << 8


class Board:
    """Remembers what is driven. `fails` lets so many transfers fail."""

    def __init__(self):
        self.now_us = 0
        self.pulse = {}
        self.duty = {}
        self.output = {}
        self.ended = []
        self.attached = {}
        self.chips = {(0, 0x40): Chip(), (0, 0x41): Chip(), (1, 0x40): Chip()}
        self.fails = 0
        self.on_transfer = lambda: None
        self.depth = 0
        self.calls = []

    def ticks_us(self):
        return self.now_us % (1 << 30)

    def lock(self):
        self.depth += 1
        return self.depth

    def unlock(self, state):
        assert state == self.depth
        self.depth -= 1

    def is_output(self, pin):
        return 2 <= pin <= 22 or 26 <= pin <= 28

    def clash(self, pin, other):
        return pin % 16 == other % 16

    def same_slice(self, pin, other):
        return pin // 2 % 8 == other // 2 % 8

    def servo_attach(self, pin, period_us, until_us):
        self.attached[pin] = period_us, until_us

    def servo_end(self, pin):
        self.ended.append(pin)
        self.attached.pop(pin)
        self.pulse.pop(pin, None)

    def servo_write(self, count, pin, due, pulse_q18us):
        for d in range(count):
            if due >> d & 1:
                assert pin[d] in self.attached
                self.pulse[pin[d]] = pulse_q18us[d]

    def bridge_attach(self, pin):
        self.attached[pin] = 50, 0
        self.duty[pin] = 0

    def bridge_write(self, pin, duty_q16):
        assert pin in self.attached
        self.calls.append(("duty", pin, duty_q16))
        self.duty[pin] = duty_q16

    def drive(self, pin, level):
        self.calls.append(("drive", pin, level))
        self.output[pin] = level

    def pin_low(self, pin):
        self.attached.pop(pin, None)
        self.pulse.pop(pin, None)
        self.duty.pop(pin, None)
        self.output[pin] = 0

    def quiet(self):
        for pin in list(self.attached):
            self.pin_low(pin)

    def i2c(self, sda, scl, baud_hz):
        number = sda // 2 % 2
        assert scl == sda + 1
        return SimpleNamespace(writeto=lambda address, data: self._write((number, address), bytes(data)))

    def _write(self, place, data):
        self.on_transfer()
        if self.fails:
            self.fails -= 1
            raise OSError(5)
        if place not in self.chips or not self.chips[place].present:
            raise OSError(5)
        self.chips[place].write(data)
        return len(data)


def tables_of(outputs, devices=(), period_us=20000, turns=None, feedback=None, kill_pin=NO_PIN):
    """Return tables with these outputs, `(driver, *settings)` by DOF or None, and devices, their settings."""
    tables = SimpleNamespace(
        dofs=len(outputs),
        motor_period_us=period_us,
        turns=bytearray([1] * DOFS),
        driver=bytearray([NO_DRIVER] * DOFS),
        settings=halves([0] * DOFS * formats.SETTINGS_MAX),
        device_driver=bytearray([NO_DRIVER] * formats.DEVICES_MAX),
        device_settings=halves([0] * formats.DEVICES_MAX * formats.DEVICE_SETTINGS_MAX),
        feedback_pin=bytearray([NO_PIN] * DOFS),
        kill_pin=kill_pin,
    )
    for dof, output in enumerate(outputs):
        if output:
            tables.driver[dof] = output[0]
            for number, value in enumerate(output[1:]):
                tables.settings[dof * formats.SETTINGS_MAX + number] = value
    for device, settings in enumerate(devices):
        tables.device_driver[device] = DRIVER_PCA9685
        for number, value in enumerate(settings):
            tables.device_settings[device * formats.DEVICE_SETTINGS_MAX + number] = value
    for dof, turn in (turns or {}).items():
        tables.turns[dof] = turn
    for dof, pin in (feedback or {}).items():
        tables.feedback_pin[dof] = pin
    return tables


def checked(tables, dof, code, *settings):
    """Return what the drivers say about an output that is to be added to tables."""
    return DRIVERS.Drivers(Board()).check_output(code, tables, dof, halves(settings), len(settings))


class Outputs:
    """Drivers with tables loaded, and a main loop that flushes what the tick has left."""

    def __init__(self, *outputs, **others):
        self.board = Board()
        self.drivers = DRIVERS.Drivers(self.board)
        self.pulse_q18us = words([1500 << 18] * DOFS)
        self.level_q24 = words([STOP_Q24] * DOFS)
        self.kept = self.load(*outputs, **others)

    def load(self, *outputs, **others):
        self.tables = tables_of(outputs, **others)
        self.drivers.prepare(self.tables)
        return self.drivers.load(self.tables)

    def attach(self, *dofs, until_us=0):
        for dof in dofs:
            self.drivers.attach(dof, until_us)

    def tick(self, due):
        self.drivers.write(self.level_q24, self.pulse_q18us, due)

    def attend(self, due=0, passed_us=2000):
        self.board.now_us += passed_us
        self.drivers.flush(self.level_q24, self.pulse_q18us, due)
        self.drivers.attend(self.board.ticks_us())

    def settle(self, passes=4):
        for _ in range(passes):
            self.attend()


# --- what is refused

BASE = {"outputs": [(DRIVER_PINS, 2), (DRIVER_BRIDGE, 0, 8, 9, 0), (DRIVER_PCA9685, 0, 3), None], "devices": [CHIP]}

OUTPUTS = [
    ((DRIVER_PINS, 3), None),
    ((DRIVER_PINS,), 0),
    ((DRIVER_PINS, 3, 0), 1),
    ((DRIVER_PINS, 0), 0),  # the UART's
    ((DRIVER_PINS, 23), 0),  # the Pico's own
    ((DRIVER_PINS, 29), 0),
    ((DRIVER_PINS, NO_PIN), 0),
    ((DRIVER_PINS, 2), 0),  # taken
    ((DRIVER_PINS, 18), 0),  # the same PWM channel
    ((DRIVER_PINS, 8), 0),  # the bridge's PWM
    ((DRIVER_PINS, 9), 0),  # its direction
    ((DRIVER_PINS, 25), 0),
    ((DRIVER_PINS, 4), 0),  # the chip's SDA, SCL and OE
    ((DRIVER_PINS, 5), 0),
    ((DRIVER_PINS, 6), 0),
    ((DRIVER_PINS, 10), 0),  # kills
    ((DRIVER_PINS, 26), 0),  # measures
    ((DRIVER_BRIDGE, 0, 12, 13, 1), None),
    ((DRIVER_BRIDGE, 1, 12, 13, 0), None),
    ((DRIVER_BRIDGE, 1, 12, 28, 0), 2),  # one channel for both
    ((DRIVER_BRIDGE, 0, 12, 28, 0), None),  # a direction has no channel
    ((DRIVER_BRIDGE, 0, 12, 12, 0), 2),
    ((DRIVER_BRIDGE, 2, 12, 13, 0), 0),
    ((DRIVER_BRIDGE, 0, 12, 13, 2), 3),
    ((DRIVER_BRIDGE, 0, 12, 13), 3),
    ((DRIVER_BRIDGE, 0, 12, 13, 0, 0), 4),
    ((DRIVER_BRIDGE, 0, 3, 13, 0), 1),  # the slice of a servo
    ((DRIVER_BRIDGE, 1, 12, 3, 0), 2),
    ((DRIVER_BRIDGE, 0, 12, 3, 0), None),
    ((DRIVER_PCA9685, 0, 4), None),
    ((DRIVER_PCA9685, 0, 3), 1),
    ((DRIVER_PCA9685, 0, 16), 1),
    ((DRIVER_PCA9685, 1, 4), 0),
    ((DRIVER_PCA9685, 4, 4), 0),
    ((DRIVER_PCA9685, 0), 1),
    ((DRIVER_PCA9685, 0, 4, 0), 2),
    ((9, 1), 0),
]


@pytest.mark.parametrize(("output", "bad"), OUTPUTS)
def test_output_is_refused_for_its_bad_setting(output, bad):
    tables = tables_of(**BASE, kill_pin=10, feedback={0: 26})
    assert checked(tables, 3, *output) == bad


@pytest.mark.parametrize(("pin", "turns", "bad"), [(3, 2, 0), (3, 1, None), (7, 2, None), (19, 1, None)])
def test_pins_of_one_slice_have_one_period(pin, turns, bad):
    tables = tables_of([(DRIVER_PINS, 2), None], period_us=8000, turns={1: turns})
    assert checked(tables, 1, DRIVER_PINS, pin) == bad


@pytest.mark.parametrize(
    ("period_us", "turns", "bad"), [(3008, 1, None), (20000, 1, None), (2000, 1, None), (400, 1, 0)]
)
def test_chip_refuses_periods_that_its_divider_cannot_make(period_us, turns, bad):
    tables = tables_of([None], devices=[CHIP], period_us=period_us, turns={0: turns})
    assert checked(tables, 0, DRIVER_PCA9685, 0, 0) == bad


def test_channels_of_one_chip_have_one_period():
    tables = tables_of([(DRIVER_PCA9685, 0, 0), None], devices=[CHIP], period_us=8000, turns={1: 2})
    assert checked(tables, 1, DRIVER_PCA9685, 0, 1) == 0


@pytest.mark.parametrize(
    ("number", "value"),
    [
        *((0, pin) for pin in (0, 5, 30)),
        *((1, pin) for pin in (4, 7, 3, 1)),
        *((2, address) for address in (0x3F, 0x70, 0x80)),
        *((3, pin) for pin in (4, 5, 23)),
        *((4, baud_khz) for baud_khz in (99, 1001)),
        *((5, clock_khz) for clock_khz in (19999, 30001)),
    ],
)
def test_device_is_refused_for_its_bad_setting(number, value):
    drivers = DRIVERS.Drivers(Board())
    settings = halves(CHIP)
    assert drivers.check_device(DRIVER_PCA9685, settings, 6) is None
    settings[number] = value
    assert drivers.check_device(DRIVER_PCA9685, settings, 6) == number


@pytest.mark.parametrize(
    ("code", "count", "bad"), [(DRIVER_PCA9685, 5, 5), (DRIVER_PINS, 0, 0), (DRIVER_BRIDGE, 1, 0), (7, 0, 0)]
)
def test_device_has_all_settings_and_a_driver_that_knows_devices(code, count, bad):
    assert DRIVERS.Drivers(Board()).check_device(code, halves(CHIP), count) == bad


@pytest.mark.parametrize(
    ("other", "bad"),
    [
        ((4, 5, 0x41, 7, 400, 25000), None),
        ((4, 5, 0x41, 6, 400, 25000), None),  # OE may be shared
        ((4, 5, 0x40, 7, 400, 25000), 0),  # one address twice
        ((8, 9, 0x41, 7, 400, 25000), 0),  # one controller at two pairs of pins
        ((4, 5, 0x41, 7, 100, 25000), 0),  # one bus at two rates
        ((2, 3, 0x40, 7, 100, 25000), None),  # the other controller
        ((2, 3, 0x40, 4, 100, 25000), 0),  # SDA of one is OE of the other
        ((6, 7, 0x40, 8, 400, 25000), 0),
    ],
)
def test_chips_share_a_bus_by_their_addresses(other, bad):
    tables = tables_of([None], devices=[CHIP, other])
    assert checked(tables, 0, DRIVER_PCA9685, 0, 0) == bad
    assert checked(tables, 0, DRIVER_PCA9685, 1, 0) == bad


def test_used_pins_are_those_of_outputs_and_devices():
    drivers = DRIVERS.Drivers(Board())
    tables = tables_of(**BASE)
    assert {pin for pin in range(30) if drivers.uses(tables, pin)} == {2, 8, 9, 4, 5, 6}


# --- pins


def test_servo_is_attached_with_its_period_and_wraps_when_its_turn_has_been_written():
    outputs = Outputs((DRIVER_PINS, 2), (DRIVER_PINS, 9), period_us=5000, turns={1: 4})
    outputs.attach(0, until_us=1234)
    outputs.attach(1, until_us=12000)
    assert outputs.board.attached == {2: (5000, 1234 + 2200), 9: (20000, 12000 + 2200)}


def test_servo_is_written_when_it_is_attached_and_due():
    outputs = Outputs((DRIVER_PINS, 2), (DRIVER_PINS, 3), (DRIVER_PINS, 7), None)
    outputs.attach(0, 2)
    outputs.tick(0b1010)
    assert outputs.board.pulse == {}
    outputs.tick(0b0101)
    assert outputs.board.pulse == {2: 1500 << 18, 7: 1500 << 18}
    outputs.drivers.release(2)
    assert outputs.board.output == {} and outputs.board.ended == [7], "a pulse under way is given whole"
    outputs.drivers.release(2)
    outputs.drivers.release(3)
    outputs.drivers.attach(3, 0)
    outputs.tick(0b1111)
    assert set(outputs.board.attached) == set(outputs.board.pulse) == {2}
    outputs.drivers.quiet()
    assert outputs.board.output == {2: 0}
    outputs.tick(0b1111)


@pytest.mark.parametrize("output", [(DRIVER_PINS, 10), (DRIVER_BRIDGE, 0, 10, 11, 0), (DRIVER_BRIDGE, 1, 10, 11, 0)])
def test_output_that_is_attached_is_not_disturbed_by_being_attached(output):
    outputs = Outputs(output)
    outputs.level_q24[0] = 1 << 24
    outputs.attach(0, until_us=7)
    outputs.tick(1)
    before = dict(outputs.board.attached), dict(outputs.board.duty)
    outputs.attach(0, until_us=8)
    assert (outputs.board.attached, outputs.board.duty) == before


def test_servos_that_stay_go_on_and_the_others_fall_silent():
    outputs = Outputs((DRIVER_PINS, 2), (DRIVER_PINS, 3), (DRIVER_PINS, 7), (DRIVER_PINS, 8))
    assert outputs.kept == 0
    outputs.attach(0, 1, 2)
    kept = outputs.load((DRIVER_PINS, 7), (DRIVER_PINS, 2), (DRIVER_PINS, 8), None, (DRIVER_BRIDGE, 0, 3, 4, 0))
    assert kept == 0b00011
    assert set(outputs.board.attached) == {2, 7} and outputs.board.output == {3: 0}
    outputs.tick(0b11111)
    assert set(outputs.board.pulse) == {2, 7}


def test_servo_with_another_period_has_to_be_attached_anew():
    outputs = Outputs((DRIVER_PINS, 2))
    outputs.attach(0)
    assert outputs.load((DRIVER_PINS, 2), period_us=10000) == 0
    assert outputs.board.attached == {}


# --- bridges


@given(st.lists(levels_q24, min_size=1, max_size=6), st.booleans())
def test_wheel_has_the_nearest_duty_and_turns_round_through_a_stand(levels, invert):
    duty, backward = words([0]), bytearray(1)
    for level in levels:
        duty_before, backward_before = duty[0], backward[0]
        BRIDGE._steer(1, words([level]), bytes([invert]), 1, duty, backward)
        speed = (STOP_Q24 - level if invert else level - STOP_Q24) / STOP_Q24
        wanted = int(abs(speed) * 65536 + 0.5)
        if duty_before and wanted and (speed < 0) != backward_before:
            assert (duty[0], backward[0]) == (0, backward_before)
        else:
            assert (duty[0], backward[0]) == (wanted, (speed < 0) if wanted else backward_before)


def test_wheel_that_is_not_due_keeps_its_duty():
    duty, backward = words([7, 7, 7]), bytearray(3)
    BRIDGE._steer(3, words([1 << 24] * 3), bytes(3), 0b010, duty, backward)
    assert list(duty) == [7, 65536, 7]


@pytest.mark.parametrize("wiring", [0, 1])
@pytest.mark.parametrize("invert", [0, 1])
def test_bridge_never_sees_both_directions_or_an_old_duty_in_a_new_one(wiring, invert):
    outputs = Outputs(None, (DRIVER_BRIDGE, wiring, 10, 11, invert))
    board = outputs.board
    outputs.attach(1)
    assert board.duty[10] == 0 and (board.duty[11] if wiring else board.output[11]) == 0
    course = [STOP_Q24 + step * 0x100000 for step in (0, 3, 8, 8, -2, -2, -8, 0, 5, 5, -1, 4, 4)]
    for level in course:
        before = {pin: board.duty.get(pin, 0) for pin in (10, 11)}
        backward_before = board.output.get(11, 0)
        outputs.level_q24[1] = level
        outputs.tick(0b10)
        if wiring:
            # what the hardware still has of the old period, and what comes, on the other side
            assert 0 in (board.duty[10], board.duty[11])
            assert 0 in (before[10], board.duty[11]) and 0 in (before[11], board.duty[10])
        elif board.output[11] != backward_before:
            assert before[10] == 0
    assert sum(board.duty.values()) == 0x400000 >> 7
    forward = board.duty[10] > 0 if wiring else board.output[11] == 0
    assert forward != bool(invert)


def test_bridge_sets_its_direction_before_the_new_duty():
    outputs = Outputs((DRIVER_BRIDGE, 0, 10, 11, 0))
    outputs.attach(0)
    outputs.board.calls.clear()
    outputs.level_q24[0] = 0
    outputs.tick(1)
    assert outputs.board.calls == [("drive", 11, 1), ("duty", 10, 65536)]


def test_bridge_stands_when_it_is_released_or_all_is_quiet_and_begins_at_duty_0():
    outputs = Outputs((DRIVER_BRIDGE, 1, 10, 11, 0), (DRIVER_BRIDGE, 0, 12, 13, 0))
    board = outputs.board
    outputs.level_q24[0] = outputs.level_q24[1] = 0
    outputs.attach(0, 1)
    outputs.tick(0b11)
    assert board.duty == {10: 0, 11: 65536, 12: 65536}
    outputs.drivers.release(0)
    assert board.duty == {12: 65536} and board.output[10] == board.output[11] == 0
    outputs.drivers.quiet()
    assert board.duty == {} and board.output[12] == 0
    outputs.tick(0b11)
    assert board.duty == {}
    outputs.attach(1)
    assert board.duty == {12: 0} and board.output[13] == 0


@pytest.mark.parametrize(
    ("changed", "kept"), [((1, 10, 11, 0), 1), ((1, 11, 10, 0), 0), ((1, 10, 11, 1), 0), ((0, 10, 11, 0), 0)]
)
def test_bridge_goes_on_if_nothing_about_it_changes(changed, kept):
    outputs = Outputs((DRIVER_BRIDGE, 1, 10, 11, 0))
    outputs.attach(0)
    assert outputs.load((DRIVER_BRIDGE, *changed)) == kept
    assert set(outputs.board.attached) == ({10, 11} if kept else set())


# --- the PCA9685


def exact_scale(clock_khz, prescale):
    return Fraction(clock_khz, 1000 * (prescale + 1))


@given(
    st.integers(formats.MOTOR_PERIOD_MIN_US // 8, 2621).map(lambda eighths: 8 * eighths),
    st.integers(20000, 30000),
    pulses_q18us,
)
def test_channel_is_high_for_the_nearest_number_of_counts(period_us, clock_khz, pulse_q18us):
    prescale = PCA9685.prescale(clock_khz, period_us)
    exact = exact_scale(clock_khz, prescale)
    assert 3 <= prescale <= 255
    assert abs(4096 / exact - period_us) <= Fraction(1, 2) * 4096 * 1000 / clock_khz
    registers = bytearray(1 + 4 * 16)
    PCA9685._fill(
        16, bytes([255, 5, *[255] * 14]), 1 << 5, 1 << 5, words([pulse_q18us] * 16), int(exact * (1 << 21)), registers
    )
    counts = registers[7] | registers[8] << 8
    # The width is cut off to a 32nd of a microsecond, the scale to 2^-21 of a count.
    lost = exact / 32 + Fraction(formats.PULSE_MAX_US, 1 << 21)
    assert abs(counts - min(Fraction(pulse_q18us, 1 << 18) * exact, 4095)) <= Fraction(1, 2) + lost
    assert {at for at, byte in enumerate(registers) if byte} <= {7, 8}


def test_channel_without_pulses_is_off_for_good_and_one_that_is_not_due_keeps_its_own():
    registers = bytearray([0xAA] * 65)
    dof = bytes([0, 1, 2, *[255] * 13])
    PCA9685._fill(16, dof, 0b101, 0b100, words([1000 << 18] * 16), 1 << 20, registers)
    assert list(registers[:13]) == [0xAA] * 7 + [0, 0x10] + [0xAA] * 2 + [500 & 255, 500 >> 8]


def running_chip(*channels, **others):
    """Return outputs on a chip that has been set up."""
    outputs = Outputs(*[(DRIVER_PCA9685, 0, channel) for channel in channels], devices=[CHIP], **others)
    outputs.settle()
    return outputs, outputs.board.chips[0, 0x40]


def test_chip_is_set_up_asleep_and_off_with_oe_high():
    outputs = Outputs((DRIVER_PCA9685, 0, 3), devices=[CHIP])
    assert outputs.board.output == {6: 1}
    outputs.settle()
    chip = outputs.board.chips[0, 0x40]
    assert (chip.register[MODE1], chip.register[MODE2]) == (AUTO_INCREMENT, 0x04)
    assert chip.register[PRE_SCALE] == 121
    assert [chip.counts(channel) for channel in range(16)] == [0] * 16
    assert outputs.board.output == {6: 1}


def test_chip_sends_all_channels_in_one_burst_and_then_lets_them_out():
    outputs, chip = running_chip(3, 5)
    outputs.attach(0, 1)
    outputs.attend()
    assert outputs.board.output[6] == 1
    outputs.pulse_q18us[1] = 2000 << 18
    before = chip.transfers
    outputs.board.on_transfer = lambda: outputs.board.output[6] == 1 or pytest.fail("not yet written")
    outputs.attend(due=0b11)
    assert chip.transfers == before + 1
    assert [chip.counts(channel) for channel in (3, 4, 5)] == [307, 0, 410]
    assert outputs.board.output[6] == 0
    assert outputs.drivers.bus_errors() == outputs.drivers.bus_gone() == 0


def test_channel_is_switched_off_by_its_release_and_oe_with_the_last():
    outputs, chip = running_chip(3, 5)
    outputs.attach(0, 1)
    outputs.attend(due=0b11)
    outputs.drivers.release(0)
    outputs.attend()
    assert chip.counts(3) == 0 and chip.counts(5) > 0 and outputs.board.output[6] == 0
    outputs.drivers.release(1)
    assert outputs.board.output[6] == 1
    outputs.attach(1)
    assert outputs.board.output[6] == 1
    outputs.attend(due=0b10)
    assert outputs.board.output[6] == 0 and chip.counts(3) == 0


def test_quiet_in_the_middle_of_a_burst_leaves_the_outputs_off():
    outputs, chip = running_chip(3)
    outputs.attach(0)
    outputs.board.on_transfer = outputs.drivers.quiet
    outputs.attend(due=1)
    outputs.board.on_transfer = lambda: None
    assert outputs.board.output[6] == 1
    outputs.settle()
    assert outputs.board.output[6] == 1 and chip.counts(3) == 0
    outputs.attach(0)
    outputs.attend(due=1)
    assert outputs.board.output[6] == 0 and chip.counts(3) == 307


@pytest.mark.parametrize(("failures", "gone"), [(1, 0), (2, 0), (3, 1)])
def test_transfer_is_repeated_twice(failures, gone):
    outputs, chip = running_chip(3)
    outputs.attach(0)
    outputs.board.fails = failures
    outputs.drivers.flush(outputs.level_q24, outputs.pulse_q18us, 1)
    assert (outputs.drivers.bus_errors(), outputs.drivers.bus_gone()) == (failures, gone)
    assert outputs.board.output[6] == gone and chip.counts(3) == (0 if gone else 307)


def test_short_transfer_is_a_failed_one(monkeypatch):
    outputs, _ = running_chip(3)
    monkeypatch.setattr(outputs.drivers._drivers[DRIVER_PCA9685]._chips[0]._bus, "writeto", lambda address, data: 1)
    outputs.attach(0)
    outputs.attend(due=1)
    assert outputs.drivers.bus_gone() == 1


def test_chip_that_comes_back_is_found_each_500_ms_and_starts_with_the_present_values():
    outputs, chip = running_chip(3)
    outputs.attach(0)
    outputs.attend(due=1)
    chip.present = False
    outputs.attend(due=1)
    assert outputs.drivers.bus_gone() == 1 and outputs.drivers.bus_errors() == 3
    for _ in range(50):
        outputs.attend(due=1, passed_us=20_000)
    assert outputs.drivers.bus_errors() == 5, "one question in 500 ms"
    chip.present = True
    chip.power_up()
    outputs.pulse_q18us[0] = 2000 << 18
    for _ in range(27):
        outputs.attend(due=1, passed_us=20_000)
    assert outputs.drivers.bus_gone() == 0 and outputs.drivers.bus_errors() == 5
    assert chip.counts(3) == 410 and chip.register[PRE_SCALE] == 121
    assert outputs.board.output[6] == 0


def test_chip_that_was_killed_while_it_was_gone_comes_back_silent():
    outputs, chip = running_chip(3)
    outputs.attach(0)
    outputs.attend(due=1)
    chip.present = False
    outputs.attend(due=1)
    outputs.drivers.quiet()
    assert outputs.board.output[6] == 1
    chip.present = True
    for _ in range(60):
        outputs.attend(passed_us=20_000)
    assert outputs.drivers.bus_gone() == 0 and chip.counts(3) == 0 and outputs.board.output[6] == 1


def test_probes_hold_over_the_wrap_of_the_ticks():
    outputs, chip = running_chip(3)
    outputs.board.now_us = (1 << 30) - 30_000
    outputs.attach(0)
    chip.present = False
    outputs.attend(due=1)
    chip.present = True
    for _ in range(27):
        outputs.attend(due=1, passed_us=20_000)
    assert outputs.drivers.bus_gone() == 0


def test_chips_that_share_oe_are_let_out_together():
    second = (4, 5, 0x41, 6, 400, 25000)
    outputs = Outputs((DRIVER_PCA9685, 0, 0), (DRIVER_PCA9685, 1, 0), devices=[CHIP, second])
    outputs.board.chips[0, 0x41].present = False
    outputs.settle()
    outputs.attach(0, 1)
    outputs.attend(due=0b11)
    assert outputs.drivers.bus_gone() == 0b10 and outputs.board.output[6] == 1
    outputs.board.chips[0, 0x41].present = True
    for _ in range(60):
        outputs.attend(due=0b11, passed_us=20_000)
    assert outputs.board.output[6] == 0
    assert [outputs.board.chips[0, address].counts(0) for address in (0x40, 0x41)] == [307, 307]


def test_chip_that_is_killed_in_a_burst_and_lost_holds_those_off_that_share_its_oe():
    second = (4, 5, 0x41, 6, 400, 25000)
    outputs = Outputs((DRIVER_PCA9685, 0, 0), (DRIVER_PCA9685, 1, 0), devices=[CHIP, second])
    outputs.settle()
    chip = outputs.board.chips[0, 0x40]
    outputs.attach(0)

    def kill():
        outputs.board.on_transfer = lambda: None
        outputs.drivers.quiet()

    outputs.board.on_transfer = kill
    outputs.drivers.flush(outputs.level_q24, outputs.pulse_q18us, 1)
    assert chip.counts(0) == 307, "it has the pulse that it must not let out"
    chip.present = False
    outputs.attach(1)
    for _ in range(3):
        outputs.attend(due=0b10)
    assert outputs.board.output[6] == 1
    chip.present = True
    for _ in range(30):
        outputs.attend(due=0b10, passed_us=20_000)
    assert outputs.board.output[6] == 0 and chip.counts(0) == 0


def test_channels_that_stay_go_on_without_a_break():
    outputs, chip = running_chip(3, 5)
    outputs.attach(0, 1)
    outputs.attend(due=0b11)
    transfers = chip.transfers
    assert outputs.load((DRIVER_PCA9685, 0, 7), None, (DRIVER_PCA9685, 0, 3), devices=[CHIP]) == 0b100
    assert outputs.board.output[6] == 0
    outputs.attend()
    assert chip.transfers == transfers + 1, "the chip itself stays as it is"
    assert [chip.counts(channel) for channel in (3, 7)] == [307, 0]


@pytest.mark.parametrize(("number", "value"), [(2, 0x41), (3, 7), (5, 26000)])
def test_chip_whose_settings_change_is_set_up_anew(number, value):
    outputs, _ = running_chip(3)
    outputs.attach(0)
    outputs.attend(due=1)
    other = [*CHIP]
    other[number] = value
    assert outputs.load((DRIVER_PCA9685, 0, 3), devices=[other]) == 0
    assert outputs.board.output[6] == 1 and outputs.board.output[other[3]] == 1
    outputs.settle()
    outputs.attach(0)
    outputs.attend(due=1)
    assert outputs.board.output[other[3]] == 0
    chip = outputs.board.chips[0, other[2]]
    assert chip.register[PRE_SCALE] == (127 - 1 if value == 26000 else 121)


def test_chip_that_is_gone_from_the_tables_is_left_alone_with_oe_high():
    outputs, chip = running_chip(3)
    outputs.attach(0)
    outputs.attend(due=1)
    assert outputs.load((DRIVER_PINS, 9)) == 0
    assert outputs.board.output[6] == 1
    transfers = chip.transfers
    outputs.settle()
    assert chip.transfers == transfers
    assert outputs.drivers.bus_gone() == 0


@pytest.mark.parametrize("channels", [*itertools.combinations((0, 1, 7, 15), 2), (4,)])
def test_burst_covers_the_channels_in_use(channels):
    outputs, chip = running_chip(*channels)
    outputs.attach(*range(len(channels)))
    outputs.attend(due=3)
    assert [channel for channel in range(16) if chip.counts(channel)] == [*channels]
