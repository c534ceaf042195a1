"""Guards: when DOFs get their pulses and when they lose them, by a virtual clock; the bucket against exact fractions."""

import random
from fractions import Fraction
from itertools import pairwise
from types import SimpleNamespace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.checked import load_checked
from tests.kernels.values import halves, integers, words

ATTENDED = (
    "Guards.attend",
    "Guards.disarm",
    "Guards._queue",
    "Guards._attach_next",
    "Guards._attach",
    "Guards._detach",
)
MODULE = load_checked("firmware/guards.py", bytecode=ATTENDED)
ONE, HALF, ZERO = 1 << 24, 1 << 23, 1 << 28
WRAP = 1 << 30
NO_DRIVER = NEW = 255
SLOT_S, STANDS_S = 0.010, 0.100
NEAR, AWAY, UNSEEN = 1 / 512, 1 / 256, 1 / 2048


class Motor:
    """DOFs that glide to their references at a constant speed while they have pulses.

    A DOF is a dict: `relative`, `has_output`, `release_ms`, `duty` with `window_s`, `speed` (per second).
    `log` has (instant in seconds, "attach" or "detach", DOF); `moved_s` per DOF when it had last moved by
    more than 1/2048, or was farther than 1/512 from its reference.
    """

    def __init__(self, *dofs, attach_ms=100, period_us=20000, begin_us=0, pass_us=3000):
        self.dofs = [{"speed": 1.0} | dof for dof in dofs]
        self.tables = tables_of(self.dofs, attach_ms, period_us)
        self.now_us = begin_us
        self.begin_us = begin_us
        self.period_us, self.pass_us = period_us, pass_us
        self.attached = 0
        self.is_killed = False
        self.position_q24 = words([HALF] * 16)
        self.velocity_q24 = words([ZERO] * 16)
        self.reference_q24 = words([HALF + ZERO] * 16)
        self.feedback = SimpleNamespace(stalled=0, forgive=self._forgive)
        self.log, self.moved_s = [], [0.0] * 16
        self.stood_q24 = [HALF] * 16
        self.had_pulses_s = [0.0] * 16
        self.board = SimpleNamespace(ticks_us=self.ticks_us, lock=lambda: 7, unlock=lambda state: None)
        self.guards = MODULE.Guards(self, self.board)
        self.guards.load()
        self._ticks = 0

    @property
    def now_s(self):
        return (self.now_us - self.begin_us) * 1e-6

    def ticks_us(self):
        return self.now_us % WRAP

    def attach(self, dof):
        assert not self.attached >> dof & 1, "attached twice"
        assert self.tables.driver[dof] != NO_DRIVER
        self.attached |= 1 << dof
        self.log.append((self.now_s, "attach", dof))

    def detach(self, dof):
        assert self.attached >> dof & 1, "released twice"
        self.attached &= ~(1 << dof)
        self.velocity_q24[dof] = ZERO
        self.log.append((self.now_s, "detach", dof))

    def _forgive(self, dof):
        self.feedback.stalled &= ~(1 << dof)

    def lead(self, dof, value):
        self.reference_q24[dof] = round(value * ONE) + ZERO

    def arm(self):
        return self.guards.arm(self.ticks_us())

    def run(self, seconds, relaxing=False, each_pass=None):
        """Let time pass: motor ticks, and passes of the main loop, in which the guards are attended to."""
        end_us = self.now_us + round(seconds * 1e6)
        while self.now_us < end_us:
            self.now_us += self.pass_us
            while self._ticks * self.period_us <= self.now_us - self.begin_us:
                self._tick()
            if each_pass:
                each_pass()
            self.guards.attend(self.ticks_us(), relaxing)
            for stored in (self.guards._masks, self.guards._used_ms, self.guards._used_q15, self.guards._still_ms):
                assert min(stored) >= 0  # a 64-bit port reads words without their sign
            for dof in range(len(self.dofs)):
                self.had_pulses_s[dof] += self.pass_us * 1e-6 * (self.attached >> dof & 1)

    def _tick(self):
        self._ticks += 1
        for dof, settings_ in enumerate(self.dofs):
            off = min(max(self.reference_q24[dof] - ZERO, 0), ONE) - self.position_q24[dof]
            step = round(settings_["speed"] * self.period_us * 1e-6 * ONE)
            moved = max(-step, min(off, step)) if self.attached >> dof & 1 else 0
            self.position_q24[dof] += moved
            self.velocity_q24[dof] = moved + ZERO
            if abs(off - moved) / ONE > NEAR or abs(self.position_q24[dof] - self.stood_q24[dof]) / ONE > UNSEEN:
                self.moved_s[dof] = self.now_s
                self.stood_q24[dof] = self.position_q24[dof]

    def events(self, dof=None):
        return [(round(at, 3), what) for at, what, of in self.log if of == dof]


def tables_of(dofs, attach_ms, period_us):
    column = lambda name, value: [dof.get(name, value) for dof in dofs]  # noqa: E731
    return SimpleNamespace(
        dofs=len(dofs),
        attach_ms=attach_ms,
        motor_period_us=period_us,
        keep_dof=bytearray(column("keep", NEW)),
        relative=bytearray(column("relative", 0)),
        driver=bytearray(0 if has else NO_DRIVER for has in column("has_output", True)),
        limit_low_q24=words(round(low * ONE) for low in column("low", 0)),
        limit_high_q24=words(round(high * ONE) for high in column("high", 1)),
        release_ms=halves(column("release_ms", 0)),
        duty_q15=halves(round(duty * 32768) for duty in column("duty", 1)),
        window_s=halves(column("window_s", 0)),
    )


# ---- the kernel

DUTIES = integers(1, 32767, 16384)


@given(
    st.lists(st.tuples(integers(0, 30000, 10), st.booleans()), min_size=1, max_size=60),
    DUTIES,
    integers(1, 65535, 10),
)
def test_bucket_is_exact(steps, duty_q15, window_s):
    duty = Fraction(duty_q15, 32768)
    budget = max(1, int(duty * (1 - duty) * window_s * 1000))
    used_ms, used_q15, still, seen, masks = words([0]), words([0]), words([0]), words([HALF]), words([0] * 5)
    level, spent = Fraction(0), False
    for elapsed, attached in steps:
        masks[0] = 1 if attached else 0
        position = words([HALF])
        arrays = position, words([ZERO]), words([HALF + ZERO]), words([0]), words([ONE]), bytes(1)
        MODULE._watch(
            *arrays,
            1,
            masks,
            elapsed,
            300,
            0,
            halves([0]),
            halves([duty_q15]),
            words([budget]),
            used_ms,
            used_q15,
            still,
            seen,
        )
        level = max(Fraction(0), level + (elapsed * (1 - duty) if attached else -elapsed * duty))
        assert used_ms[0] + Fraction(used_q15[0], 32768) == level
        if int(level) >= budget:
            spent = True
        elif int(level) <= budget - budget // 4:
            spent = False
        assert masks[2] == spent
        assert masks[3] == (spent and still[0] > 100 and attached)


@given(
    integers(0, ONE, HALF),
    integers(-ONE, ONE, 0, 327, -327),
    integers(-8 * ONE, 8 * ONE, HALF),
    st.booleans(),
    st.booleans(),
    integers(0, 1 << 16, 1, 91, 101),
    integers(0, 65535, 100),
    st.booleans(),
    integers(-ONE, ONE, 0, 4096, 4097, -4096, -4097),
    st.booleans(),
)
@example(HALF, 0, HALF, True, True, 95, 0, True, 0, True)
@example(HALF, 327, HALF, False, True, 95, 0, True, -4096, True)
@example(HALF, 328, HALF, False, True, 95, 0, True, 0, True)
@example(HALF, -328, HALF, False, True, 95, 0, True, 0, True)
@example(HALF, 0, HALF, False, True, 95, 0, True, 4097, True)
@example(HALF, 0, HALF, False, True, 95, 0, True, -4097, True)
def test_dof_stands_where_it_should(
    position, velocity, reference, relative, attached, before, release_ms, relaxing, change, is_near
):
    still, masks = words([before]), words([1 if attached else 0, 1, 0, 0, 0])
    if is_near:
        position = min(max(position, ONE // 8), ONE - ONE // 8)
        reference = position + reference % ((ONE >> 9) + 2)
    low, high, seen = ONE // 8, ONE - ONE // 8, words([position - change])
    arrays = words([position]), words([velocity + ZERO]), words([reference + ZERO]), words([low]), words([high])
    full = halves([32768]), words([0]), words([0]), words([0])
    MODULE._watch(
        *arrays, bytes([relative]), 1, masks, 10, 327, int(relaxing), halves([release_ms]), *full, still, seen
    )
    off = abs(min(max(reference, low), high) - position) / ONE
    stands = attached and off <= NEAR and abs(velocity) <= 327 and abs(change) <= ONE >> 12
    stands = stands and (not relative or abs(position - HALF) <= ONE >> 12)
    assert seen[0] == position
    assert still[0] == ((min(before + 10, 1 << 16) if before else 1) if stands else 0)
    stood_ms = still[0] - 1
    assert masks[3] == (stands and stood_ms >= 100 and (relaxing or 0 < release_ms <= stood_ms))
    assert masks[4] == (not attached and off > AWAY)


# ---- attaching


@pytest.mark.parametrize("begin_us", [0, WRAP - 150_000])
@pytest.mark.parametrize("attach_ms", [0, 50, 100, 2000])
def test_dofs_attach_one_after_the_other(begin_us, attach_ms):
    dofs = [{}, {"has_output": False}, {}, {"relative": 1}, {}]
    motor = Motor(*dofs, attach_ms=attach_ms, begin_us=begin_us, pass_us=1000)
    motor.run(0.1)
    assert motor.log == [] and motor.guards.armed == 0
    assert motor.arm()
    motor.run(4 * attach_ms * 1e-3 + 0.05)
    assert [dof for _, _, dof in motor.log] == [0, 2, 3, 4]
    instants = [at for at, _, _ in motor.log]
    assert instants == pytest.approx([0.1 + n * attach_ms * 1e-3 for n in range(4)], abs=0.0031)
    assert (motor.guards.armed, motor.guards.released) == (0b11101, 0)


def test_dofs_never_attach_closer_than_said_however_slow_the_main_loop():
    motor = Motor({}, {}, {}, {}, attach_ms=50, pass_us=37_000)
    motor.arm()
    motor.run(1)
    instants = [at for at, _, _ in motor.log]
    assert all(0.049 <= after - at <= 0.087 for at, after in pairwise(instants))


def test_jitter_of_the_main_loop_does_not_make_an_attachment_miss_its_turn():
    motor = Motor({}, {}, {}, {}, attach_ms=100, pass_us=20_000)
    motor.arm()
    draw = random.Random(1)
    begin_us = motor.now_us
    for n in range(1, 20):
        motor.now_us = begin_us + 20_000 * n + draw.randint(-300, 300)
        motor.guards.attend(motor.ticks_us(), False)
    assert [at for at, _, _ in motor.log] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=3.1e-4)


def test_disarming_ends_the_sequence_and_every_return():
    motor = Motor({}, {"release_ms": 200}, {}, {})
    motor.arm()
    motor.run(0.15)
    motor.guards.disarm()
    motor.attached = 0
    for dof in range(4):
        motor.lead(dof, 0.9)
    motor.run(3)
    assert len(motor.log) == 2 and (motor.guards.armed, motor.guards.released) == (0, 0)


def test_puppet_without_outputs_cannot_be_armed():
    motor = Motor({"has_output": False})
    assert not motor.arm()


# ---- stillness


def test_dof_is_let_go_after_stillness_and_comes_back_to_move():
    motor = Motor({"release_ms": 500}, {})
    motor.arm()
    motor.lead(0, 0.7)
    motor.run(0.1)
    motor.run(1.5)
    _, (released, what) = motor.events(0)
    stood_s = motor.moved_s[0]
    assert what == "detach" and stood_s + 0.5 <= released <= stood_s + 0.5 + 2 * SLOT_S + 0.02
    assert motor.guards.released == 1
    motor.lead(0, 0.7 + 0.9 * AWAY)
    motor.run(1)
    assert len(motor.events(0)) == 2
    asked_s = motor.now_s
    motor.lead(0, 0.7 + 1.1 * AWAY)
    motor.run(0.2)
    assert motor.events(0)[2][1] == "attach" and motor.events(0)[2][0] - asked_s <= SLOT_S + 0.003
    assert motor.guards.released == 0 and motor.attached >> 1 & 1


def test_target_out_of_range_is_reached_at_the_end_of_the_range():
    motor = Motor({"release_ms": 300})
    motor.tables.limit_high_q24[0] = HALF
    motor.arm()
    motor.lead(0, 0.5)
    motor.run(0.1)
    motor.reference_q24[0] = ONE + ZERO
    motor.dofs[0]["speed"] = 0.0
    motor.run(1)
    assert motor.guards.released == 1


def test_relative_dof_is_let_go_only_at_0():
    motor = Motor({"relative": 1, "release_ms": 300})
    motor.arm()
    motor.lead(0, 0.75)  # half speed, steadily
    motor.run(5)
    assert motor.attached == 1
    motor.lead(0, 0.5)
    motor.run(1)
    assert motor.guards.released == 1
    motor.lead(0, 0.51)
    motor.run(0.1)
    assert motor.attached == 1


MOVES = st.lists(
    st.tuples(st.integers(0, 2), st.floats(0, 1), st.floats(0.02, 1.5), st.booleans()), min_size=5, max_size=40
)


@settings(max_examples=40, deadline=None)
@given(MOVES, st.sampled_from([20000, 3008]), st.sampled_from([1000, 3000, 14000]), st.sampled_from([0.2, 1.0, 5.0]))
def test_dof_is_never_let_go_in_mid_move(moves, period_us, pass_us, speed):
    dofs = [
        {"release_ms": 150, "speed": speed},
        {"relative": 1, "release_ms": 100, "duty": 0.3, "window_s": 2, "speed": speed},
        {"duty": 0.2, "window_s": 1, "speed": speed},
    ]
    motor = Motor(*dofs, period_us=period_us, pass_us=pass_us, attach_ms=20)
    motor.arm()
    seen = 0
    for dof, value, seconds, relaxing in moves:
        motor.lead(dof, 0.5 if dof == 1 and value < 0.5 else value)

        def check():
            nonlocal seen
            for at, what, of in motor.log[seen:]:
                if what == "detach":
                    assert at - motor.moved_s[of] >= STANDS_S - 1e-6
                    assert of != 1 or abs(motor.position_q24[1] - HALF) <= ONE >> 12
            seen = len(motor.log)

        motor.run(seconds, relaxing, check)
        check()


def test_turning_point_of_a_motion_is_no_stillness():
    motor = Motor({"duty": 0.1, "window_s": 1, "speed": 0.4}, pass_us=1000)
    motor.arm()
    for n in range(20):
        motor.lead(0, 0.3 + 0.4 * (n % 2))
        motor.run(1.0 if n else 0.5)  # the time that the way takes
    assert [what for _, what, _ in motor.log] == ["attach"]


# ---- budget


@pytest.mark.parametrize("duty", [0.1, 0.25, 0.5, 0.9])
def test_share_of_pulses_keeps_to_its_budget(duty):
    window_s, longest_move_s = 4, 0.4
    motor = Motor({"duty": duty, "window_s": window_s, "speed": 2.5}, attach_ms=0, pass_us=2000)
    motor.arm()
    draw = random.Random(3)
    course = []  # (instant, time with pulses until then)
    at_s = 0.0
    while at_s < 40 * window_s:
        motor.lead(0, draw.random())
        pause_s = draw.uniform(longest_move_s + 0.15, 1.0)
        motor.run(pause_s)
        at_s += pause_s
        course.append((motor.now_s, motor.had_pulses_s[0]))
    # the bucket holds `duty * (1 - duty) * window`; it may be exceeded while a move lasts and until the DOF is seen to stand
    overrun_s = (longest_move_s + STANDS_S + 3 * SLOT_S + 0.02) * (1 - duty)
    for place, (begin_s, had_s) in enumerate(course):
        for end_s, has_s in course[place + 1 :: 7]:
            allowed_s = duty * (end_s - begin_s + (1 - duty) * window_s) + overrun_s
            assert has_s - had_s <= allowed_s
    share = course[-1][1] / course[-1][0]
    assert 0.9 * duty <= share <= 1.05 * duty  # it asks for pulses all the time


def test_budget_is_used_up_and_a_quarter_of_it_is_recovered():
    motor = Motor({"duty": 0.5, "window_s": 8, "speed": 5.0}, attach_ms=0, pass_us=1000)
    motor.arm()
    motor.run(10)
    assert motor.events(0)[1] == (pytest.approx(4.0, abs=0.02), "detach")  # duty * window, from empty
    released_s = motor.events(0)[1][0]
    motor = Motor({"duty": 0.5, "window_s": 8, "speed": 5.0}, attach_ms=0, pass_us=1000)
    motor.arm()
    motor.run(released_s)
    motor.lead(0, 0.9)
    motor.run(3)
    # a quarter of 0.5 * 0.5 * 8 s flows away in 1 s
    assert motor.events(0)[2] == (pytest.approx(released_s + 1.0, abs=0.03), "attach")


def test_used_up_budget_outlives_a_new_arm():
    motor = Motor({"duty": 0.5, "window_s": 8, "speed": 5.0}, {}, attach_ms=0)
    motor.arm()
    motor.run(4.2)
    assert motor.guards.released == 1
    motor.guards.disarm()
    motor.attached = 0
    motor.arm()
    motor.run(0.1)
    assert motor.attached == 2 and motor.guards.released == 1


# ---- relaxing


def test_relaxing_lets_go_each_dof_as_it_stands_and_all_come_back_in_turn():
    motor = Motor({"speed": 0.2}, {"speed": 0.5}, {}, {"relative": 1}, attach_ms=100, pass_us=1000)
    motor.arm()
    for dof in range(3):
        motor.lead(dof, 0.8)
    motor.run(3)
    for dof in range(3):
        motor.lead(dof, 0.3)  # rest
    motor.lead(3, 0.5)
    begin_s = motor.now_s
    motor.run(4, relaxing=True)
    for dof, way_s in ((0, 2.5), (1, 1.0), (2, 0.5)):
        at, what = motor.events(dof)[-1]
        assert what == "detach" and at - begin_s == pytest.approx(way_s + STANDS_S, abs=0.04)
    assert motor.attached == 0 and motor.guards.released == 0b1111
    begin_s = motor.now_s
    motor.run(1)
    back = [(at - begin_s, dof) for at, what, dof in motor.log if what == "attach"][-4:]
    assert [dof for _, dof in back] == [0, 1, 2, 3]
    assert [at for at, _ in back] == pytest.approx([0.01 + 0.1 * n for n in range(4)], abs=0.012)


def test_relaxing_lets_a_released_dof_glide_to_rest_first():
    motor = Motor({"release_ms": 200})
    motor.arm()
    motor.run(1)
    assert motor.attached == 0
    motor.lead(0, 0.2)
    motor.run(2, relaxing=True)
    assert [what for _, what, _ in motor.log] == ["attach", "detach", "attach", "detach"]
    assert motor.position_q24[0] == pytest.approx(0.2 * ONE, abs=2)


# ---- stalls


def test_stalled_dof_is_let_go_at_once_until_the_next_arm():
    motor = Motor({"release_ms": 200}, {})
    motor.arm()
    motor.run(0.5)
    motor.lead(1, 0.9)
    motor.run(0.05)
    motor.feedback.stalled = 2
    begin_s = motor.now_s
    motor.run(0.1)
    at, what = motor.events(1)[-1]
    assert what == "detach" and at - begin_s <= SLOT_S + 0.003
    assert motor.guards.stalled == 2 and motor.guards.released & 2
    motor.lead(1, 0.1)
    motor.run(1)
    motor.run(1, relaxing=True)
    motor.run(1)
    assert not motor.attached & 2 and motor.guards.stalled == 2
    motor.arm()
    motor.run(0.3)
    assert motor.attached & 2 and motor.guards.stalled == 0


# ---- the rest


def test_exchange_keeps_who_is_armed_and_what_is_used():
    motor = Motor({"duty": 0.5, "window_s": 8}, {}, {}, attach_ms=0)
    motor.arm()
    motor.run(4.2)
    assert motor.attached == 0b110
    motor.dofs = [{"speed": 1.0, "keep": 2}, {"speed": 1.0}, {"speed": 1.0, "duty": 0.5, "window_s": 8, "keep": 0}]
    motor.tables = tables_of(motor.dofs, 0, 20000)
    motor.attached = 0b001
    used_ms = motor.guards._used_ms[0]
    motor.guards.load()
    assert used_ms > 1900 and list(motor.guards._used_ms[:3]) == [0, 0, used_ms]
    motor.run(0.1)
    assert (motor.guards.armed, motor.attached, motor.guards.released) == (0b101, 0b001, 0b100)
    motor.run(2)
    motor.lead(2, 0.9)
    motor.lead(1, 0.9)
    motor.run(0.1)
    assert motor.attached == 0b101


@pytest.mark.parametrize("pass_us", [500, 10_000, 25_000])
def test_long_run_over_the_clock_s_wrap(pass_us):
    motor = Motor({"release_ms": 300}, begin_us=WRAP - 2_000_000, pass_us=pass_us)
    motor.arm()
    for n in range(4):
        motor.lead(0, 0.3 + 0.1 * (n % 2))
        motor.run(1.0)
    assert [what for _, what, _ in motor.log] == ["attach", "detach"] * 4
