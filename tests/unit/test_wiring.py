"""Robot files: outputs, chips, pins, pulses, and the mistakes in them."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.drivers import Bridge, Channel, Pca9685, Pin
from marotte.limits import Limits
from marotte.outputs import Duty, Feedback, Output
from marotte.puppet_file import load_puppet
from marotte.tomlfile import FileMistakes
from marotte.wiring import Kill, Robot, load_robot, read_robot
from shared import formats
from tests.reference_motor import driven

PUPPETS = Path(__file__).parents[2] / "puppets"

CHIP = "[chip.FACE]\nsda=4\nscl=5\noe=6\n"
PUPPET = "[dof.NECK]\nlimits=[0.1, 0.6]\n[dof.JAW]\n[dof.WHEEL]\nkind='relative'\n[dof.OTHER]\nkind='relative'\n"


def robot_of(tmp_path, text, puppet=None):
    path = tmp_path / "r.toml"
    path.write_text(text)
    return load_robot(path, puppet)


def mistakes_of(tmp_path, text, puppet=None):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    _, mistakes = read_robot(path, puppet)
    if mistakes:
        with pytest.raises(FileMistakes):
            load_robot(path, puppet)
    return [str(mistake).removeprefix(str(path)) for mistake in mistakes]


@pytest.fixture
def puppet(tmp_path):
    (tmp_path / "puppet.toml").write_text(PUPPET)
    return load_puppet(tmp_path / "puppet.toml")


def test_robot_reads_everything(tmp_path, puppet):
    robot = robot_of(
        tmp_path,
        """
        name = "one"
        mcu = "rp2040"
        link_timeout = 1.5
        rate = 100
        attach_interval = 0.25
        autostart = true
        [kill]
        pin = 22
        switch = "open"
        [chip.FACE]
        driver = "pca9685"
        sda = 4
        scl = 5
        oe = 6
        address = 0x41
        baud = 100000
        clock = 25.5
        [output.NECK]
        pin = 28
        pulse_us = [2000, 1000.5]
        trim_us = -12.5
        invert = true
        rate = 50
        range = [0.2, 0.8]
        speed = 4
        accel = 30.5
        release = 2.5
        duty = { share = 0.5, window = 30 }
        feedback = { pin = 26, at = [0.1, 0.9], gain = 0.2, integral = 1, most = 0.05, stall = 0.1, stall_time = 0.3 }
        [output.JAW]
        driver = "pca9685"
        chip = "FACE"
        channel = 15
        [output.WHEEL]
        driver = "bridge"
        pwm = 2
        direction = 3
        dead_band = 0.2
        top_speed = 0.9
        invert = true
        range = [-0.5, 1]
        accel = 8
        [output.OTHER]
        driver = "bridge"
        wiring = "two-pwm"
        forward = 10
        backward = 11
        """,
        puppet,
    )
    assert (robot.name, robot.mcu, robot.link_timeout_s) == ("one", "rp2040", 1.5)
    assert (robot.rate_hz, robot.attach_interval_s, robot.autostart) == (100, 0.25, True)
    assert robot.kill == Kill(22, "open")
    assert robot.chips == {"FACE": Pca9685("FACE", 4, 5, 6, 0x41, 100000, 25.5)}
    assert robot.outputs["NECK"] == Output(
        "NECK",
        Pin(28),
        (2000.0, 1000.5),
        -12.5,
        True,
        50.0,
        Limits((0.2, 0.8), 4.0, 30.5),
        release_s=2.5,
        duty=Duty(0.5, 30.0),
        feedback=Feedback(26, (0.1, 0.9), 0.2, 1.0, 0.05, 0.1, 0.3),
    )
    assert robot.outputs["JAW"] == Output("JAW", Channel("FACE", 15))
    assert robot.outputs["WHEEL"] == Output(
        "WHEEL",
        Bridge("pwm-direction", (2, 3)),
        invert=True,
        limits=Limits((-0.5, 1.0), None, 8.0),
        dead_band=0.2,
        top_speed=0.9,
    )
    assert robot.outputs["OTHER"] == Output("OTHER", Bridge("two-pwm", (10, 11)))


def test_robot_defaults(tmp_path):
    robot = robot_of(tmp_path, "[output.A]\npin=2\n[kill]\npin=22\n" + CHIP)
    assert robot == Robot(
        "r",
        outputs={"A": Output("A", Pin(2))},
        kill=Kill(22, "closed"),
        chips={"FACE": Pca9685("FACE", 4, 5, 6, 0x40, 400_000, 25.0)},
    )
    assert (robot.link_timeout_s, robot.rate_hz, robot.attach_interval_s, robot.autostart) == (0.5, 50, 0.1, False)


@pytest.mark.parametrize(("switch", "level"), [("closed", 1), ("open", 0)])
def test_kill_is_at_the_level_of_a_broken_or_pressed_switch(switch, level):
    assert Kill(22, switch).level == level


@pytest.mark.parametrize(
    ("output", "ends_us"),
    [
        (Output("A", Pin(2)), (1000, 2000)),
        (Output("A", Pin(2), (900, 2100), 10), (910, 2110)),
        (Output("A", Pin(2), (900, 2100), 10, True), (2110, 910)),
        (Output("A", Pin(2), (2100, 900), -10, True), (890, 2090)),
    ],
)
def test_output_ends_have_trim_and_inversion(output, ends_us):
    assert output.ends_us == ends_us


@pytest.mark.parametrize(
    ("speed", "drive"),
    [(0, 0), (1, 0.9), (-1, -0.9), (1 / 64, 0.2 + 0.7 / 64), (1 / 128, 0.1 + 0.7 / 128), (-0.5, -0.55)],
)
def test_output_drives_a_wheel_beyond_its_dead_band(speed, drive):
    output = Output("W", Bridge("two-pwm", (2, 3)), dead_band=0.2, top_speed=0.9)
    assert output.drive_of(speed) == pytest.approx(drive)


@given(speed=st.floats(-1, 1), dead=st.floats(0, 0.5), more=st.floats(0.1, 0.5))
def test_output_drives_a_wheel_as_the_motor_layer_does(speed, dead, more):
    output = Output("W", Bridge("two-pwm", (2, 3)), dead_band=dead, top_speed=dead + more)
    assert output.drive_of(speed) == pytest.approx(driven(speed, dead, dead + more))


# rate of the robot, of each output; period of the ticks, turns of each output
RATES = [
    (50, [None, 50], 20000, [1, 1]),
    (100, [None, 50], 10000, [1, 2]),
    (50, [None, 100, 200], 5000, [4, 2, 1]),
    (333, [None, 50], 3008, [1, 6]),  # 7 turns would be 21056 us, more than a PWM can do
    (333, [333, 166.5, 60], 3008, [1, 2, 6]),
    (60, [50], 16672, [1]),
    (300, [80], 3336, [4]),
]


def wired(rate_hz, rates_hz):
    outputs = {f"D{i}": Output(f"D{i}", Pin(2 * i), rate_hz=rate) for i, rate in enumerate(rates_hz)}
    return Robot(rate_hz=rate_hz, outputs=outputs)


@pytest.mark.parametrize(("rate_hz", "rates_hz", "period_us", "turns"), RATES)
def test_robot_ticks_as_quickly_as_its_quickest_output(rate_hz, rates_hz, period_us, turns):
    robot = wired(rate_hz, rates_hz)
    assert robot.motor_period_us == period_us
    assert [robot.turns(output) for output in robot.outputs.values()] == turns


@given(rate_hz=st.floats(50, 333), rates_hz=st.lists(st.floats(50, 333), max_size=4))
def test_robot_periods_are_what_the_mcu_takes(rate_hz, rates_hz):
    robot = wired(rate_hz, rates_hz)
    period_us = robot.motor_period_us
    assert formats.MOTOR_PERIOD_MIN_US <= period_us <= formats.MOTOR_PERIOD_MAX_US
    assert period_us % formats.MOTOR_PERIOD_STEP_US == 0
    assert 0 <= period_us - 1e6 / max([rate_hz, *rates_hz]) < formats.MOTOR_PERIOD_STEP_US
    for output in robot.outputs.values():
        written_us = robot.written_us(output)
        assert written_us <= formats.PWM_PERIOD_MAX_US
        asked_us = 1e6 / output.rate_hz
        assert abs(written_us - asked_us) <= period_us / 2 + 0.5 or written_us > formats.PWM_PERIOD_MAX_US - period_us


@pytest.mark.parametrize(
    ("clock_mhz", "asked_us", "period_us"), [(25, 20000, 19988.48), (25, 3008, 2949.12), (26.5, 10000, 10046.792453)]
)
def test_chip_has_the_nearest_period_of_its_prescaler(clock_mhz, asked_us, period_us):
    chip = Pca9685("FACE", 4, 5, 6, clock_mhz=clock_mhz)
    assert chip.period_us(asked_us) == pytest.approx(period_us)
    # the register of the data sheet: round(clock / (4096 * rate)) - 1
    register = round(clock_mhz * asked_us / 4096) - 1
    assert chip.period_us(asked_us) == pytest.approx((register + 1) * 4096 / clock_mhz)


@pytest.mark.parametrize("name", ["pet-robot.toml", "pet-robot-pca9685.toml"])
def test_robot_of_the_pet_moves_every_dof(name):
    puppet = load_puppet(PUPPETS / "pet.toml")
    assert set(load_robot(PUPPETS / name, puppet).outputs) == set(puppet.dofs)


A, B = "[output.A]\n", "[output.B]\n"
MISTAKES = [
    # the outermost keys
    ('mcu="esp32"', ':1 mcu: found "esp32", expected "rp2040"'),
    ("link_timeout=0", ":1 link_timeout: found 0, expected a number in 0.1..60"),
    ("rate=49.9", ":1 rate: found 49.9, expected a number in 50..333"),
    ("rate=334", ":1 rate: found 334, expected a number in 50..333"),
    ("attach_interval=2.1", ":1 attach_interval: found 2.1, expected a number in 0..2"),
    ("autostart=1", ":1 autostart: found 1, expected true or false"),
    ("[outputs.A]\npin=2", 'outputs: unknown key; did you mean "output"?'),
    ("output=3", ":1 output: found 3, expected a table"),
    # the kill pin
    ("[kill]", ':1 kill: has no "pin"; expected the number of the pin of the switch, 0..29'),
    ("[kill]\npin=1", ":2 kill.pin: found 1, expected another pin: GP0 and GP1 are the link's UART"),
    ('[kill]\npin=2\nswitch="shut"', ':3 kill.switch: found "shut", expected "closed" or "open"'),
    ("[kill]\npin=2\nlevel=1", ":3 kill.level: unknown key"),
    (f"[kill]\npin=2\n{A}pin=2", ":4 output.A.pin: found 2, which is the kill pin already"),
    # chips
    ("[chip.F]", ':1 chip.F: has no "sda"; expected the number of the pin that is SDA, 0..29'),
    (
        "[chip.F]",
        ':1 chip.F: has no "oe"; expected the number of the pin at its OE, which takes all pulses away at once',
    ),
    (CHIP + 'driver="pca9865"', ':5 chip.FACE.driver: found "pca9865", expected "pca9685"'),
    (CHIP + "address=63", ":5 chip.FACE.address: found 63, expected a whole number in 64..127"),
    (CHIP + "address=0x70", ":5 chip.FACE.address: found 112 (0x70), expected another address"),
    (CHIP + "baud=50000", ":5 chip.FACE.baud: found 50000, expected a whole number in 100000..1000000"),
    (CHIP + "clock=19", ":5 chip.FACE.clock: found 19, expected a number in 20..30"),
    (CHIP.replace("sda=4", "sda=5"), ":2 chip.FACE.sda: found 5, expected a pin that can be SDA: 2, 4, 6, 8, 10, 12"),
    (CHIP.replace("scl=5", "scl=8"), ":3 chip.FACE.scl: found 8, expected a pin that can be SCL: 3, 5, 7, 9, 11, 13"),
    (
        CHIP.replace("scl=5", "scl=7"),
        ":3 chip.FACE.scl: found 7, which belongs to I2C1, while GP4 (sda) belongs to I2C0; expected 5, 9, 13, 17 or 21",
    ),
    (CHIP.replace("oe=6", "oe=24"), ":4 chip.FACE.oe: found 24, expected another pin: on a Pico, GP24 is wired"),
    (CHIP.replace("oe=6", "oe=5"), ":4 chip.FACE.oe: found 5, which is SCL of I2C0 already"),
    (
        CHIP + "[chip.G]\nsda=8\nscl=9\noe=7",
        ":6 chip.G.sda: found GP8 and GP9, but I2C0 has GP4 and GP5 already; expected these",
    ),
    (CHIP + "[chip.G]\nsda=4\nscl=5\noe=7", ":5 chip.G.address: 64 (0x40) is the address of FACE on the same bus"),
    (
        CHIP + "[chip.G]\nsda=4\nscl=5\noe=7\naddress=65\nbaud=100000",
        ":10 chip.G.baud: found 100000, expected 400000 as FACE has on the same bus",
    ),
    (
        "".join(f"[chip.C{i}]\nsda=2\nscl=3\noe=6\naddress={64 + i}\n" for i in range(5)),
        "has 5 chips, expected at most 4",
    ),
    # outputs at pins
    (A, ':1 output.A: has no "pin"; expected the number of its pin, 0..29'),
    (A + "pin=30", ":2 output.A.pin: found 30, expected a whole number in 0..29"),
    (A + 'pin="GP2"', ':2 output.A.pin: found "GP2", expected a whole number'),
    (A + "pin=0", ":2 output.A.pin: found 0, expected another pin: GP0 and GP1 are the link's UART"),
    (A + "pin=25", ":2 output.A.pin: found 25, expected another pin: on a Pico, GP25 is wired"),
    (A + "pin=29", ":2 output.A.pin: found 29, expected another pin: on a Pico, GP29 is wired"),
    (A + 'pin=2\ndriver="pin"', ':3 output.A.driver: found "pin", expected "pins" or "pca9685" or "bridge"'),
    (A + "pin=2\npulse_us=[1000]", ":3 output.A.pulse_us: found 1 values, expected 2: the pulse widths"),
    (A + "pin=2\npulse_us=[200,2000]", ":3 output.A.pulse_us[0]: found 200, expected a number in 300..3000"),
    (
        A + "pin=2\npulse_us=[1500,1500]",
        ":3 output.A.pulse_us: found [1500, 1500], expected two pulse widths, 1/16 us apart at least",
    ),
    (A + "pin=2\npulse_us=[1500.02,1500.01]", ":3 output.A.pulse_us: found [1500.02, 1500.01], expected two pulse"),
    (A + "pin=2\ntrim_us=301", ":3 output.A.trim_us: found 301, expected a number in -300..300"),
    (
        A + "pin=2\npulse_us=[400,2900]\ntrim_us=200",
        ":4 output.A.trim_us: with its trim the pulses end at 600 and 3100",
    ),
    (A + "pin=2\ninvert=1", ":3 output.A.invert: found 1, expected true or false"),
    (A + "pin=2\npuls_us=[1,2]", ':3 output.A.puls_us: unknown key; did you mean "pulse_us"?'),
    (A + "pin=2\nchannel=2", ":3 output.A.channel: unknown key"),
    (A + "pin=2\nrate=400", ":3 output.A.rate: found 400, expected a number in 50..333"),
    (A + "pin=2\nrange=[0.5,0.5]", ":3 output.A.range: found [0.5, 0.5], expected the least value first"),
    (A + "pin=2\nrange=[-2,0.5]", ":3 output.A.range[0]: found -2, expected a number in -1..1"),
    (A + "pin=2\nspeed=0.01", ":3 output.A.speed: found 0.01, expected a number in 0.05..50"),
    (A + "pin=2\naccel=1001", ":3 output.A.accel: found 1001, expected a number in 1..1000"),
    (A + "pin=2\ndead_band=0.6", ":3 output.A.dead_band: found 0.6, expected a number in 0..0.5"),
    (A + "pin=2\ntop_speed=0", ":3 output.A.top_speed: found 0, expected a number in 0.1..1"),
    (
        A + "pin=2\ndead_band=0.4\ntop_speed=0.4",
        ":4 output.A.top_speed: found 0.4, expected more than the dead band of 0.4",
    ),
    (
        A + "pin=2\ndead_band=0.3\ntop_speed=0.300001",
        ":4 output.A.top_speed: found 0.300001, expected more than the dead band of 0.3, by 1/32768 at least",
    ),
    (
        A + "pin=2\ndead_band=0.3\ntop_speed=0.3000000001",
        ":4 output.A.top_speed: found 0.3000000001, expected more than the dead band of 0.3, by 1/32768 at least",
    ),
    (A + "pin=2\nrelease=0", ":3 output.A.release: found 0, expected a number in 0.1..60"),
    (A + "pin=2\nduty=0.5", ":3 output.A.duty: found 0.5, expected a table"),
    (A + "pin=2\nduty={}", ':3 output.A.duty: has no "share"; expected the share of the time'),
    (A + "pin=2\nduty={share=0}", ":3 output.A.duty.share: found 0, expected a number in 0.05..1"),
    (
        A + "pin=2\nduty={share=0.5, window=601}",
        ":3 output.A.duty.window: found 601, expected a whole number in 1..600",
    ),
    (
        A + "pin=2\nduty={share=0.5, window=1.2}",
        ":3 output.A.duty.window: found 1.2, expected a whole number in 1..600",
    ),
    (A + "pin=2\nduty={share=0.5, windows=6}", ':3 output.A.duty.windows: unknown key; did you mean "window"?'),
    (
        A + "pin=2\nfeedback={at=[0,1]}",
        ':3 output.A.feedback: has no "pin"; expected the number of the pin that measures, 26..28',
    ),
    (A + "pin=2\nfeedback={pin=26}", ':3 output.A.feedback: has no "at"; expected what is measured'),
    (A + "pin=2\nfeedback={pin=22, at=[0,1]}", ":3 output.A.feedback.pin: found 22, expected a whole number in 26..28"),
    (A + "pin=2\nfeedback={pin=26, at=[0,1.1]}", ":3 output.A.feedback.at[1]: found 1.1, expected a number in 0..1"),
    (
        A + "pin=2\nfeedback={pin=26, at=[0.5,0.51]}",
        ":3 output.A.feedback.at: found [0.5, 0.51], expected values at least 0.015625 apart",
    ),
    (A + "pin=2\nfeedback={pin=26, at=[0,1], gain=2}", ":3 output.A.feedback.gain: found 2, expected a number in 0..1"),
    (A + "pin=2\nfeedback={pin=26, at=[0,1], integral=11}", "feedback.integral: found 11, expected a number in 0..10"),
    (A + "pin=2\nfeedback={pin=26, at=[0,1], most=0.6}", "feedback.most: found 0.6, expected a number in 0..0.5"),
    (A + "pin=2\nfeedback={pin=26, at=[0,1], stall=0}", "feedback.stall: found 0, expected a number in 0.02..1"),
    (
        A + "pin=2\nfeedback={pin=26, at=[0,1], stall_time=0}",
        "feedback.stall_time: found 0, expected a number in 0.1..10",
    ),
    (A + "pin=26\nfeedback={pin=26, at=[0,1]}", ":3 output.A.feedback.pin: found 26, which drives A already"),
    # pins that clash
    (f"{A}pin=2\n{B}pin=2", ":4 output.B.pin: found 2, which drives A already"),
    (f"{A}pin=2\n{B}pin=18", ":4 output.B.pin: found 18, expected another pin: it shares a PWM channel with GP2 of A"),
    (
        f"rate=100\n{A}pin=2\nrate=50\n{B}pin=3",
        ":6 output.B.pin: found 3, expected another pin: it shares a PWM slice with GP2 of A, so they would need one period, "
        "and have 10000 and 20000 us",
    ),
    (f"{A}pin=2\n{B}pin=19\nrate=100", ":4 output.B.pin: found 19, expected another pin: it shares a PWM slice"),
    (
        f'{A}pin=2\n{B}driver="bridge"\npwm=3\ndirection=8',
        ":5 output.B.pwm: found 3, expected another pin: it shares a PWM slice with GP2 of A",
    ),
    (f"{CHIP}{A}pin=4", ":6 output.A.pin: found 4, which is SDA of I2C0 already"),
    (f"{CHIP}{A}pin=6", ":6 output.A.pin: found 6, which is OE of a chip already"),
    # channels
    (f'{CHIP}{A}driver="pca9685"', ':5 output.A: has no "chip"; expected the name of its [chip.NAME]'),
    (f'{CHIP}{A}driver="pca9685"', ':5 output.A: has no "channel"; expected the number of its channel, 0..15'),
    (
        f'{CHIP}{A}driver="pca9685"\nchip="FAC"\nchannel=1',
        ':7 output.A.chip: found "FAC", which is no chip of this file; did',
    ),
    (f'{A}driver="pca9685"\nchip="X"\nchannel=1', "which is no chip of this file; expected the name of a [chip.NAME]"),
    (
        f'{CHIP}{A}driver="pca9685"\nchip="FACE"\nchannel=16',
        ":8 output.A.channel: found 16, expected a whole number in 0..15",
    ),
    (
        f'{CHIP}{A}driver="pca9685"\nchip="FACE"\nchannel=1\n{B}driver="pca9685"\nchip="FACE"\nchannel=1',
        ":12 output.B.channel: found 1, which drives A already",
    ),
    (
        f'{CHIP}{A}driver="pca9685"\nchip="FACE"\nchannel=1\n{B}driver="pca9685"\nchip="FACE"\nchannel=2\nrate=100',
        ":12 output.B.channel: its pulses would have a period of 9994.24 us, those of A on the same chip have 19988.5 us",
    ),
    (
        f'{CHIP}{A}driver="pca9685"\nchip="FACE"\nchannel=1\nrate=333\npulse_us=[1000,2950]',
        ":10 output.A.pulse_us: the pulses are up to 2950 us long, but begin every 2949.12 us; expected ones that leave 200 us",
    ),
    # bridges
    (f'{A}driver="bridge"', ':1 output.A: has no "pwm"; expected the number of the pin at "pwm", 0..29'),
    (f'{A}driver="bridge"', ':1 output.A: has no "direction"'),
    (f'{A}driver="bridge"\nwiring="two-pwm"', ':1 output.A: has no "backward"'),
    (f'{A}driver="bridge"\nwiring="x"', ':3 output.A.wiring: found "x", expected "pwm-direction" or "two-pwm"'),
    (f'{A}driver="bridge"\npwm=2\ndirection=2', ":4 output.A.direction: found 2, which drives A already"),
    (
        f'{A}driver="bridge"\nwiring="two-pwm"\nforward=2\nbackward=18',
        ":5 output.A.backward: found 18, expected another pin: it shares a PWM channel with GP2 of A",
    ),
    (f'{A}driver="bridge"\npwm=2\ndirection=3\npulse_us=[1,2]', ":5 output.A.pulse_us: unknown key"),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[expected[:70] for _, expected in MISTAKES])
def test_robot_mistake_is_named_and_placed(tmp_path, text, expected):
    found = mistakes_of(tmp_path, text)
    assert any(expected in line for line in found), found


FINE = [
    f'{A}driver="bridge"\nwiring="two-pwm"\nforward=2\nbackward=3\n{B}driver="bridge"\npwm=4\ndirection=5',
    f'{A}driver="bridge"\npwm=2\ndirection=18',
    f'{A}pin=2\n{B}driver="bridge"\npwm=4\ndirection=18',
    f"{A}pin=2\n{B}pin=3",
    f"rate=200\n{A}pin=2\nrate=50\n{B}pin=4",
    CHIP + "[chip.G]\nsda=4\nscl=5\noe=6\naddress=65\n",
    CHIP + "[chip.G]\nsda=2\nscl=3\noe=6\n",
    CHIP + '[output.A]\ndriver="pca9685"\nchip="FACE"\nchannel=0\n[output.B]\npin=7\nrate=100\n',
]


@pytest.mark.parametrize("text", FINE)
def test_robot_may_share_what_can_be_shared(tmp_path, text):
    assert mistakes_of(tmp_path, text) == []


KINDS = [
    ("[output.NEK]\npin=2\n", ':1 output.NEK: the puppet has no such DOF; did you mean "NECK"?'),
    (
        '[output.NECK]\ndriver="bridge"\npwm=2\ndirection=3',
        ':2 output.NECK.driver: found "bridge", expected another driver',
    ),
    ("[output.NECK]\npin=2\ndead_band=0.1", ":3 output.NECK.dead_band: expected none: this DOF is absolute"),
    ("[output.NECK]\npin=2\ntop_speed=1", ":3 output.NECK.top_speed: expected none: this DOF is absolute"),
    ("[output.NECK]\npin=2\nrange=[-0.5,0.5]", ":3 output.NECK.range[0]: found -0.5, expected a number in 0..1"),
    (
        "[output.NECK]\npin=2\nrange=[0.7,1]",
        ":3 output.NECK.range: found [0.7, 1], of which the puppet's limits 0.1..0.6 leave nothing",
    ),
    ("[output.WHEEL]\npin=2\nrange=[0.1,0.5]", ":3 output.WHEEL.range: found [0.1, 0.5], expected 0 within"),
    ("[output.WHEEL]\npin=2\nspeed=3", ":3 output.WHEEL.speed: a relative DOF has none"),
    ("[output.WHEEL]\npin=2\naccel=3", ":3 output.WHEEL.accel: found 3, expected a number in 4..1000"),
    (
        "[output.WHEEL]\npin=2\nfeedback={pin=26, at=[0,1]}",
        ":3 output.WHEEL.feedback: expected none: this DOF is relative",
    ),
]


@pytest.mark.parametrize(("text", "expected"), KINDS, ids=[expected[:60] for _, expected in KINDS])
def test_robot_is_checked_against_the_puppet(tmp_path, puppet, text, expected):
    found = mistakes_of(tmp_path, text, puppet)
    assert len(found) == 1 and expected in found[0], found


def test_robot_reports_all_mistakes(tmp_path):
    text = (
        "link_timeout=99\n[output.A]\npin=1\ninvert=3\n[output.B]\npulse_us=3\n[kill]\n[chip.F]\nsda=3\nscl=4\noe=5\n"
    )
    keys = ["link_timeout", "output.A.pin", "output.A.invert", "output.B", "output.B.pulse_us", "kill", "chip.F.sda"]
    assert [line.split(" ")[1].rstrip(":") for line in mistakes_of(tmp_path, text)] == keys
