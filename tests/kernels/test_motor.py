"""What the motor tick remembers of itself, in 32 bits, and the motor layer on a board whose ticks come when a test wants.

It remembers the positions of the last ticks, how long it took, how late it came.
"""

from hypothesis import given
from hypothesis import strategies as st

from shared.formats import (
    DOFS_MAX,
    DRIVER_PINS,
    KILLED_BY_PIN,
    KILLED_BY_STOPPED_TICKS,
    KIND_ABSOLUTE,
    MOTOR_PERIOD_MAX_US,
    MOTOR_PERIOD_MIN_US,
    POSITION_ONE,
    VALUE_ONE,
)
from tests.checked import load_checked
from tests.kernels.values import halves, integers, words

MOTOR = load_checked("firmware/motor.py")
TABLES = load_checked("firmware/tables.py")
EXCHANGE = load_checked("firmware/exchange.py")
TICKS_MODULUS = 1 << 30
TICK_US = 20_000
KILL_PIN = 22

positions_q24 = st.lists(integers(0, POSITION_ONE, POSITION_ONE // 2), min_size=DOFS_MAX, max_size=DOFS_MAX)
instants_us = integers(0, TICKS_MODULUS - 1, TICKS_MODULUS // 2)
periods_us = integers(MOTOR_PERIOD_MIN_US, MOTOR_PERIOD_MAX_US)


@given(st.integers(1, DOFS_MAX), positions_q24, positions_q24, positions_q24)
def test_positions_of_the_last_two_ticks_are_shifted(dofs, now, before, oldest):
    remembered = words([*before, *oldest])
    MOTOR._remember(words(now), remembered, dofs)
    assert list(remembered[:dofs]) == now[:dofs]
    assert list(remembered[DOFS_MAX : DOFS_MAX + dofs]) == before[:dofs]
    assert list(remembered[dofs:DOFS_MAX]) == before[dofs:]
    assert list(remembered[DOFS_MAX + dofs :]) == oldest[dofs:]


@given(
    instants_us, periods_us, st.lists(st.tuples(integers(0, 300_000), integers(0, 300_000)), min_size=1, max_size=20)
)
def test_longest_and_latest_tick_are_measured_against_the_first(first_us, period_us, ticks):
    times_us = words([0, 0, -1])
    for number, (late_us, took_us) in enumerate(ticks):
        begun_us = first_us + number * period_us + (late_us if number else 0)
        MOTOR._measure(times_us, period_us, begun_us % TICKS_MODULUS, (begun_us + took_us) % TICKS_MODULUS)
    assert times_us[0] == max(took_us for _, took_us in ticks)
    assert times_us[1] == max((late_us for late_us, _ in ticks[1:]), default=0)


class Board:
    """Calls its ticks when `run` says; `fed` is how often the watchdog was."""

    def __init__(self):
        self.now_us = self.fed = 0
        self.kill_level = 1
        self.handler = None

    def run(self, motor, ticks, calls=True):
        """Let ticks pass, with or without a call of their handler, the main loop looking after the motors behind each."""
        for _ in range(ticks):
            self.now_us += TICK_US
            if calls:
                self.handler()
            motor.attend()
            motor.maintain()

    def ticks_us(self):
        return self.now_us % TICKS_MODULUS

    def tick_due_us(self):
        return (self.now_us + TICK_US) % TICKS_MODULUS

    def start_ticks(self, period_us, handler):
        self.handler = handler

    def stop_ticks(self):
        self.handler = None

    def lock(self):
        return 0

    def unlock(self, state):
        pass

    def level(self, pin):
        return self.kill_level

    def input_pullup(self, pin):
        pass

    def feed(self):
        self.fed += 1

    def keep_pose(self, dofs, position_q24):
        pass

    def kept_pose(self, dofs, position_q24, tag):
        return False


class Drivers:
    """Remembers which DOFs have pulses. `load` finds every output in use before, whichever DOF's it was."""

    def __init__(self):
        self.pulsing = 0

    def prepare(self, tables):
        pass

    def load(self, tables):
        return self.pulsing

    def attach(self, dof, until_us):
        self.pulsing |= 1 << dof

    def release(self, dof):
        self.pulsing &= ~(1 << dof)

    def quiet(self):
        self.pulsing = 0

    def write(self, level_q24, pulse_q18us, due):
        assert due & ~self.pulsing == 0

    def flush(self, level_q24, pulse_q18us, due):
        pass

    def attend(self, now_us):
        pass


def tables_of(*pins):
    """Return tables of one servo on each pin, with a pin that kills when it is low."""
    tables = TABLES.Tables()
    assert tables.begin(30, len(pins), *[0] * 8, 1, 500, 0) is None
    assert tables.robot(TICK_US, 0, KILL_PIN, 0, 0) is None
    for dof, pin in enumerate(pins):
        assert tables.dof(dof, KIND_ABSOLUTE, VALUE_ONE // 2, 0, VALUE_ONE, POSITION_ONE, POSITION_ONE, 1) is None
        assert tables.output(dof, DRIVER_PINS, 1, 16_000, 32_000, 0, VALUE_ONE, halves([pin]), 1) is None
    return tables


def armed_motor(*pins):
    """Return a motor layer whose servos have pulses while nothing plays, its board and its drivers."""
    board, drivers = Board(), Drivers()
    motor = MOTOR.Motor(board, drivers, TABLES.Tables())
    motor.load(tables_of(*pins))
    assert motor.arm()
    board.run(motor, 3)
    assert drivers.pulsing == motor.attached == (1 << len(pins)) - 1
    return motor, board, drivers


def test_kill_pin_acts_in_a_tick_when_nothing_plays():
    motor, board, drivers = armed_motor(2, 3)
    board.kill_level = 0
    board.handler()
    assert (motor.armed, motor.attached, drivers.pulsing, motor.killed_by) == (False, 0, 0, KILLED_BY_PIN)


def test_silence_is_counted_in_ticks_when_nothing_plays():
    motor, board, _ = armed_motor(2)
    motor.heard()
    board.run(motor, 500_000 // TICK_US)
    assert not motor.silent
    board.run(motor, 1)
    assert motor.silent


def test_ticks_that_stop_cost_the_pulses_and_leave_the_watchdog_hungry():
    motor, board, drivers = armed_motor(2)
    fed = board.fed
    board.run(motor, 2)
    assert board.fed == fed + 2
    board.run(motor, 5, calls=False)
    assert (motor.armed, drivers.pulsing) == (True, 1), "ticks may be late by 100 ms"
    board.run(motor, 1, calls=False)
    assert (motor.armed, drivers.pulsing, motor.killed_by) == (False, 0, KILLED_BY_STOPPED_TICKS)
    assert board.fed == fed + 2


def test_dof_that_gets_the_output_of_another_begins_without_its_pulses():
    motor, board, drivers = armed_motor(2, 3, 4)
    tables = tables_of(3, 2, 4)
    tables.keep_dof[:3] = bytes([0, 1, 2])
    motor.exchange(tables, EXCHANGE.gather_words, EXCHANGE.gather_halves, words([0] * DOFS_MAX))
    assert drivers.pulsing == motor.attached == 0b100
    board.run(motor, 3)
    assert drivers.pulsing == motor.attached == 0b111
