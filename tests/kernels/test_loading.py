"""Tables from the wire are not trusted: whatever comes in whatever order, it is stored within the arrays or refused."""

from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats, messages, program
from tests.checked import load_checked
from tests.kernels.values import integers

MODULE = load_checked("firmware/tables.py")
RANGES = {"B": (0, 255), "H": (0, 65535), "I": (0, (1 << 32) - 1), "i": (-(1 << 31), (1 << 31) - 1)}
BEGIN = {
    "frame_rate_hz": 30,
    "dofs": 2,
    "actions": 2,
    "mappings": 3,
    "lives": 1,
    "curves": 2,
    "programs": 2,
    "blinks": 1,
    "seed": 1,
    "spread_q15": 0,
    "hold_q26": 1,
    "link_timeout_ms": 500,
    "when_silent": 0,
}
ROBOT = {"motor_period_us": 20000, "attach_ms": 100, "kill_pin": formats.NO_PIN, "kill_level": 0, "autostart": 0}
FIELDS = {name: (fields, items) for name, _, fields, items in messages.MESSAGES}


def numbers(kind):
    """Any number of a message's type, and often one that may be right."""
    least, greatest = RANGES[kind]
    return st.integers(0, 3) | integers(least, greatest, 16, 255, 257, 65536)


def calls(method, *kinds):
    return st.tuples(st.just(method), st.tuples(*map(numbers, kinds)))


def fields(name):
    return [kind for _, kind in FIELDS[name][0]]


def items(name):
    return [kind for _, kind in FIELDS[name][1]]


@st.composite
def calls_with_settings(draw, name):
    """A call with settings: the buffer for them, and how many there are, which may be more than it has room for."""
    method, arguments = draw(calls(name, *fields(name)))
    settings = draw(st.lists(numbers("H"), min_size=8, max_size=8))
    return method, (*arguments, settings, draw(st.integers(0, 120)))


PLAIN = ("robot", "dof", "character", "feedback", "guard", "action", "live", "blink", "curve", "program")
SETTERS = {"calibrate": "bad_calibration", "limit": "bad_limit"}

any_call = st.one_of(
    *(calls(name, *fields(name)) for name in (*PLAIN, *SETTERS)),
    *(calls_with_settings(name) for name in ("device", "output")),
    calls("mapping", *fields("mappings"), *items("mappings")),
    calls("sample", *items("curve")),
    calls("word", *items("program")),
    calls("keep", *fields("keep"), "B", *items("keep")),
)


class Drivers:
    """Drivers that refuse a setting of 3, by its number."""

    def check_device(self, driver, settings, count):
        return next((place for place in range(count) if settings[place] == 3), None)

    def check_output(self, driver, tables, dof, settings, count):
        assert tables.driver[dof] == formats.NO_DRIVER and tables.turns[dof] >= 1
        return self.check_device(driver, settings, count)

    def uses(self, tables, pin):
        return pin == 28


def carry_out(tables, method, arguments):
    """Call a method of the tables, one that sets what plays only if its check allows it; return the number of the bad field."""
    if method in SETTERS:
        bad = getattr(tables, SETTERS[method])(*arguments)
        return getattr(tables, method)(*arguments) if bad is None else bad
    return getattr(tables, method)(*arguments)


@given(st.booleans(), st.lists(any_call, max_size=60))
def test_tables_take_or_refuse_any_parts_in_any_order(has_robot, parts):
    tables = MODULE.Tables(Drivers())
    assert tables.begin(*BEGIN.values()) is None
    if has_robot:
        assert tables.robot(*ROBOT.values()) is None
    for method, arguments in parts:
        carry_out(tables, method, arguments)
        assert tables.missing() >= 0
    for action in range(formats.ACTIONS_MAX):
        tables.link_repeats(action)
    tables.doubled()
    for mapping in range(tables._mappings_seen):
        blinks = tables.function[mapping] in (formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN)
        assert not (blinks and tables.signal[tables.mapped_dof[mapping]])
    for live in range(tables._lives_seen):
        assert tables.live_predict[live] <= formats.PREDICT_KALMAN and tables.live_fade_q15[live] < 32768
        assert all(0 <= values[live] <= 1 << 27 for values in (tables.live_process_q16, tables.live_noise_q16))
        assert tables.live_noise_q16[live] or not tables.live_predict[live], "it divides"
    check_motor_tables(tables)


def check_motor_tables(tables):
    """Whatever came: the motor layer gets only what it can carry out."""
    assert 3008 <= tables.motor_period_us <= 20000 and tables.motor_period_us % 8 == 0
    for dof in range(formats.DOFS_MAX):
        low, high = tables.limit_low_q24[dof], tables.limit_high_q24[dof]
        assert 0 <= low <= high <= 1 << 24
        assert tables.turns[dof] >= 1
        assert tables.driver[dof] == 255 or tables.turns[dof] * tables.motor_period_us < 21000
        assert 0 <= tables.dead_q15[dof] < tables.top_q15[dof] <= 32768
        assert all(0 <= number <= 1 << 29 for number in tables.response_q24[6 * dof : 6 * dof + 6])
        if tables.driver[dof] in (formats.DRIVER_PINS, formats.DRIVER_PCA9685):
            assert all(300 * 16 <= end[dof] <= 3000 * 16 for end in (tables.end0_q4us, tables.end1_q4us))
        if tables.feedback_pin[dof] != formats.NO_PIN:
            assert tables.feedback_pin[dof] in (26, 27, 28)
            assert abs(tables.feedback_at0_q15[dof] - tables.feedback_at1_q15[dof]) >= 512
    for dof in range(tables._dofs_seen):
        assert 1 <= tables.speed_q24[dof] <= 1 << 24 and 2 <= tables.accel_q24[dof] <= 1 << 24
        if tables.relative[dof]:
            stop_us = -(-(1 << 23) // tables.accel_q24[dof]) * tables.motor_period_us
            assert stop_us <= 250_000 + tables.motor_period_us, "full speed to a stand, to the next tick"
            assert tables.limit_low_q24[dof] <= 1 << 23 <= tables.limit_high_q24[dof], "it can stand"


@given(calls("begin", *fields("begin")))
def test_tables_take_or_refuse_any_beginning(part):
    tables = MODULE.Tables()
    if tables.begin(*part[1]) is None:
        assert tables.ready and tables.missing() >= 2, "the robot and a DOF"
    else:
        assert not tables.ready


GOOD = {
    "robot": ROBOT,
    "dof": {
        "dof": 0,
        "kind": 0,
        "rest_q15": 0,
        "low_q15": 0,
        "high_q15": 32768,
        "speed_q24": 1 << 24,
        "accel_q24": 1 << 24,
        "signal": 1,
    },
    "character": {"dof": 0, **{f"response{number}_q24": 0 for number in range(6)}},
    "output": {
        "dof": 0,
        "driver": formats.DRIVER_PINS,
        "turns": 1,
        "end0_q4us": 300 * 16,
        "end1_q4us": 3000 * 16,
        "dead_q15": 0,
        "top_q15": 32768,
    },
    "feedback": {
        "dof": 0,
        "pin": 26,
        "at0_q15": 32768,
        "at1_q15": 32256,
        "gain_q15": 32768,
        "integral_q24": 1 << 24,
        "most_q15": 32768,
        "stall_q15": 32768,
        "stall_ticks": 65535,
    },
    "guard": {"dof": 0, "release_ms": 65535, "duty_q15": 32768, "window_s": 0},
}


def loaded(period_us=20000, kind=formats.KIND_ABSOLUTE, driver=None):
    """Tables with a robot and one DOF, and with an output if a driver is named."""
    tables = MODULE.Tables()
    tables.begin(*(BEGIN | {"dofs": 1, "actions": 0, "mappings": 0, "lives": 0, "curves": 0}).values())
    assert tables.robot(*(ROBOT | {"motor_period_us": period_us}).values()) is None
    assert tables.dof(*(GOOD["dof"] | {"kind": kind}).values()) is None
    if driver is not None:
        ends = {"end0_q4us": 0, "end1_q4us": 0} if driver == formats.DRIVER_BRIDGE else {}
        assert tables.output(*(GOOD["output"] | {"driver": driver} | ends).values(), [], 0) is None
    return tables


@pytest.mark.parametrize(
    ("period_us", "accel_q24", "taken"),
    # 2^23 in 250 ms, per tick, rounded up: 12.5, 25, 83.1 ticks
    [
        (20000, 671089, True),
        (20000, 671088, False),
        (10000, 335545, True),
        (10000, 335544, False),
        (3008, 100932, True),
        (3008, 100931, False),
        (20000, 1 << 24, True),
        (20000, (1 << 24) + 1, False),
    ],
)
def test_relative_dofs_are_refused_if_they_cannot_stop_in_250_ms(period_us, accel_q24, taken):
    fields = GOOD["dof"] | {"kind": formats.KIND_RELATIVE, "accel_q24": accel_q24}
    tables = MODULE.Tables()
    tables.begin(*BEGIN.values())
    tables.robot(*(ROBOT | {"motor_period_us": period_us}).values())
    assert tables.dof(*fields.values()) == (None if taken else 6)
    tables = loaded(period_us, formats.KIND_RELATIVE)
    assert tables.bad_limit(0, 0, 32768, 1 << 24, accel_q24) == (None if taken else 4)


@pytest.mark.parametrize(("low", "high", "bad"), [(16385, 32768, 3), (0, 16383, 4), (16384, 16384, None)])
def test_relative_dofs_are_refused_a_range_in_which_they_cannot_stand(low, high, bad):
    tables = MODULE.Tables()
    tables.begin(*BEGIN.values())
    tables.robot(*ROBOT.values())
    fields = GOOD["dof"] | {"kind": formats.KIND_RELATIVE, "low_q15": low, "high_q15": high}
    assert tables.dof(*fields.values()) == bad
    assert MODULE.Tables.bad_limit(loaded(), 0, low, high, 1, 2) is None, "absolute DOFs may"


@pytest.mark.parametrize(
    ("period_us", "turns", "taken"),
    [
        *((20000, 0, False), (20000, 1, True), (20000, 2, False), (10480, 2, True), (10488, 2, False)),
        *((3008, 6, True), (3008, 7, False), (3008, 64, False), (3008, 65, False)),
    ],
)
def test_outputs_are_refused_a_period_that_the_pwm_cannot_count(period_us, turns, taken):
    """65535 counts of 0.32 us are 20971.2 us."""
    bad = loaded(period_us).output(*(GOOD["output"] | {"turns": turns}).values(), [], 0)
    assert bad == (None if taken else 2)


def test_tables_ask_for_a_robot_before_anything_that_it_bears_on():
    tables = MODULE.Tables()
    tables.begin(*BEGIN.values())
    assert tables.dof(*GOOD["dof"].values()) == 0
    assert tables.device(0, formats.DRIVER_PCA9685, [], 0) == 0
    missing = tables.missing()
    assert tables.robot(*ROBOT.values()) is None
    assert tables.missing() == missing - 1
    assert tables.robot(*ROBOT.values()) == 0, "once"


@pytest.mark.parametrize("name", ["character", "output", "feedback", "guard"])
def test_dofs_have_each_part_once_at_most_and_only_if_they_are_there(name):
    rest = ([], 0) if name == "output" else ()
    tables = loaded()
    assert getattr(tables, name)(*(GOOD[name] | {"dof": 1}).values(), *rest) == 0
    assert getattr(tables, name)(*GOOD[name].values(), *rest) is None
    assert getattr(tables, name)(*GOOD[name].values(), *rest) == 0


def test_beginning_anew_takes_away_what_dofs_and_devices_had():
    tables = loaded(driver=formats.DRIVER_PINS)
    tables.device(3, formats.DRIVER_PCA9685, [1] * 8, 8)
    for name in ("character", "feedback", "guard"):
        assert getattr(tables, name)(*GOOD[name].values()) is None
    tables.begin(*BEGIN.values())
    assert list(tables.driver) == [formats.NO_DRIVER] * 16 and list(tables.device_driver) == [formats.NO_DRIVER] * 4
    assert list(tables.feedback_pin) == [formats.NO_PIN] * 16 and not any(tables.has_character)
    assert not any(tables.release_ms) and list(tables.duty_q15) == [32768] * 16


@pytest.mark.parametrize("signal", [0, 1])
def test_dofs_whose_signal_is_processed_are_refused_blinks(signal):
    tables = MODULE.Tables()
    tables.begin(*(BEGIN | {"mappings": 9}).values())
    assert tables.robot(*ROBOT.values()) is None
    assert tables.mapping(0, 0, formats.FUNCTION_RSIN, 0, 0, 0) == 0, "the DOF comes first"
    assert tables.dof(*(GOOD["dof"] | {"signal": signal}).values()) is None
    assert tables.signal[0] == signal
    for function in (formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN):
        place = tables._mappings_seen
        assert tables.mapping(place, 0, function, 0, 0, 0) == (1 if signal else None)
    assert tables.mapping(tables._mappings_seen, 0, formats.FUNCTION_PROGRAM, 0, 0, 0) is None


def test_live_channels_keep_how_they_are_predicted():
    tables = MODULE.Tables()
    tables.begin(*(BEGIN | {"lives": 2}).values())
    assert tables.live(0, 1 << 27, 5, 6, formats.PREDICT_HOLD, 0, 0, 0) is None
    assert tables.live(1, 1 << 27, 5, 6, formats.PREDICT_KALMAN, 7, 1 << 27, 32767) is None
    assert list(tables.live_predict[:2]) == [0, 1]
    assert (tables.live_process_q16[1], tables.live_noise_q16[1], tables.live_fade_q15[1]) == (7, 1 << 27, 32767)


def test_settings_are_stored_in_their_place_and_the_rest_is_0():
    tables = loaded(driver=formats.DRIVER_PINS)
    assert list(tables.settings[:6]) == [0] * 6
    tables = loaded()
    tables.settings[5] = 9
    assert tables.output(*GOOD["output"].values(), [4, 5, 6, 7, 8, 9, 10, 11], 3) is None
    assert list(tables.settings) == [4, 5, 6] + [0] * (16 * 6 - 3)
    assert tables.device(2, formats.DRIVER_PCA9685, [1, 2, 3, 4, 5, 6, 7, 8], 8) is None
    assert list(tables.device_settings) == [0] * 16 + [1, 2, 3, 4, 5, 6, 7, 8] + [0] * 8
    assert loaded().output(*GOOD["output"].values(), [0] * 8, 7) == 7 + 6
    assert tables.device(1, formats.DRIVER_PCA9685, [0] * 8, 9) == 2 + 8


def test_calibration_is_checked_against_the_driver():
    assert loaded().bad_calibration(0, 16000, 32000, 0, 32768) == 0, "no output, nothing to calibrate"
    tables = loaded(driver=formats.DRIVER_PINS)
    assert tables.bad_calibration(0, 32000, 16000, 32767, 32768) is None
    assert tables.bad_calibration(0, 0, 0, 0, 32768) == 1
    tables = loaded(driver=formats.DRIVER_BRIDGE)
    assert tables.bad_calibration(0, 0, 0, 0, 1) is None
    assert tables.bad_calibration(0, 16000, 0, 0, 32768) == 1
    assert tables.bad_calibration(0, 0, 32000, 0, 32768) == 2


def test_a_pulse_leaves_a_gap_in_its_period():
    tables = loaded(driver=formats.DRIVER_PINS)
    tables.motor_period_us = 3008
    most_q4us = (tables.turns[0] * 3008 - formats.PULSE_GAP_US) << 4
    assert tables.turns[0] == 1 and most_q4us < formats.PULSE_MAX_US << 4
    assert tables.bad_calibration(0, most_q4us, most_q4us, 0, 32768) is None
    assert tables.bad_calibration(0, most_q4us + 1, 16000, 0, 32768) == 1
    assert tables.bad_calibration(0, 16000, most_q4us + 1, 0, 32768) == 2
    tables.turns[0] = 2
    assert tables.bad_calibration(0, most_q4us + 1, formats.PULSE_MAX_US << 4, 0, 32768) is None


def test_feedback_inputs_are_used_once_and_not_by_the_kill_pin():
    tables = MODULE.Tables()
    tables.begin(*BEGIN.values())
    tables.robot(*(ROBOT | {"kill_pin": 27}).values())
    for dof in range(2):
        tables.dof(*(GOOD["dof"] | {"dof": dof}).values())
    assert tables.feedback(*(GOOD["feedback"] | {"pin": 27}).values()) == 1
    assert tables.feedback(*GOOD["feedback"].values()) is None
    assert tables.feedback(*(GOOD["feedback"] | {"dof": 1}).values()) == 1
    assert tables.feedback(*(GOOD["feedback"] | {"dof": 1, "pin": 28}).values()) is None
    tables = MODULE.Tables(Drivers())
    tables.begin(*BEGIN.values())
    tables.robot(*ROBOT.values())
    tables.dof(*GOOD["dof"].values())
    assert tables.feedback(*(GOOD["feedback"] | {"pin": 28}).values()) == 1, "an output has it"
    assert loaded(kind=formats.KIND_RELATIVE).feedback(*GOOD["feedback"].values()) == 0, "a speed is not measured"


def test_curves_and_programs_fill_their_pools_and_no_more():
    tables = MODULE.Tables()
    tables.begin(*(BEGIN | {"curves": formats.CURVES_MAX, "programs": program.PROGRAMS_MAX}).values())
    curves = formats.SAMPLES_POOL // formats.SAMPLES_MAX
    for curve in range(curves):
        assert tables.curve(curve, formats.SAMPLES_MAX) is None
        assert [tables.sample(5) for _ in range(formats.SAMPLES_MAX)] == [None] * formats.SAMPLES_MAX
    assert (tables.curve(curves, 2), tables.sample(0)) == (1, 0)
    words = [program.CONST, 0, *[program.NEG] * (program.WORDS_MAX - 2)]
    programs = program.POOL_WORDS // program.WORDS_MAX
    for number in range(programs):
        assert tables.program(number, program.WORDS_MAX) is None
        assert [tables.word(word) for word in words] == [None] * program.WORDS_MAX
    assert (tables.program(programs, 2), tables.word(0)) == (1, 0)


def test_arrays_begin_with_zeros_and_no_more_is_filled():
    words, halves, octets = array("i", [-1] * 5), array("H", [65535] * 5), bytearray([255] * 5)
    MODULE._fill_words(words, 4, 1 << 29)
    MODULE._fill_halves(halves, 4, 0)
    MODULE._fill_bytes(octets, 4, 7)
    assert (list(words), list(halves)) == ([1 << 29] * 4 + [-1], [0, 0, 0, 0, 65535])
    assert list(octets) == [7, 7, 7, 7, 255]
    assert (MODULE.words(300), MODULE.halves(300)) == (array("i", [0] * 300), array("H", [0] * 300))
