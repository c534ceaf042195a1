"""The PCA9685 on the emulated RP2040's I2C bus, against its data sheet (NXP, Rev. 4): registers and outputs."""

import itertools

import pytest

from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu

ADDRESS = 0x40
OE_PIN = 6
CHANNELS = range(16)
CYCLE = 4096
MODE1, MODE2, LED0, ALL_LED, PRESCALE = 0, 1, 6, 0xFA, 0xFE
AWAKE, ASLEEP = 0x21, 0x31  # with auto-increment and the all-call address
RESTART = 0x80
ON_ACK = 0x0C  # MODE2: totem pole, outputs change on acknowledgement
FULL = 0x1000
WAKE_UP_US = 500
PRESCALE_50_HZ = 121
POWER_ON = bytes([0x11, 0x04, 0xE2, 0xE4, 0xE8, 0xE0]) + bytes([0, 0, 0, 0x10]) * 16


class Servos:
    """A PCA9685 at 0x40 of bus 0 with OE at pin 6, and the REPL to write to it."""

    def __init__(self, mcu, clock_hz=25_000_000):
        self.mcu = mcu
        self.chip = mcu.add_pca9685(0, ADDRESS, OE_PIN, clock_hz)
        self.clock_hz = clock_hz
        self.repl = RawRepl(mcu)
        self.repl.exec("from machine import I2C, Pin\ni2c = I2C(0, sda=Pin(4), scl=Pin(5), freq=400000)")

    def write(self, register, *values):
        self.repl.exec(f"i2c.writeto_mem({ADDRESS}, {register}, bytes({list(values)}))")

    def read(self, register, count=1):
        return bytes.fromhex(self.repl.exec(f"print(i2c.readfrom_mem({ADDRESS}, {register}, {count}).hex())"))

    def wake(self, prescale=PRESCALE_50_HZ):
        self.write(MODE1, ASLEEP)
        self.write(PRESCALE, prescale)
        self.write(MODE1, AWAKE)
        self.mcu.run_for(WAKE_UP_US)
        self.cycle_ns = CYCLE * (prescale + 1) * 1e9 / self.clock_hz
        self.count_ns = self.cycle_ns / CYCLE

    def set(self, channel, on, off):
        self.write(LED0 + 4 * channel, *counts(on, off))

    def after(self, edges):
        """Edges seen in the next three cycles."""
        self.mcu.clear_edges()
        self.mcu.run_for(int(3 * self.cycle_ns / 1000))
        return self.chip.edges(edges)


def counts(on, off):
    return on & 255, on >> 8, off & 255, off >> 8


@pytest.fixture
def servos(pico):
    return Servos(pico)


def rises(edges):
    return [t for t, level in edges if level]


def widths(edges):
    return [fall - rise for (rise, level), (fall, _) in itertools.pairwise(edges) if level]


# ---- registers


def test_pca9685_wakes_up_asleep_and_off(servos):
    assert servos.chip.registers()[: LED0 + 64] == POWER_ON
    assert servos.chip.registers()[PRESCALE] == 0x1E
    servos.mcu.run_for(50_000)
    assert all(servos.chip.edges(channel) == [] for channel in CHANNELS)


def test_pca9685_increments_its_register_only_if_told(servos):
    servos.write(LED0, 1, 2, 3, 4)
    assert servos.chip.registers()[LED0 : LED0 + 4] == bytes([4, 0, 0, 0x10])
    servos.write(MODE1, ASLEEP)
    servos.write(LED0, 1, 2, 3, 4)
    assert servos.chip.registers()[LED0 : LED0 + 4] == bytes([1, 2, 3, 4])
    assert servos.read(LED0 + 62, 4) == bytes([0, 0x10, ASLEEP, 0x04])  # behind the last one comes the first
    servos.write(ALL_LED + 3, 0x10, 50, AWAKE)
    assert (servos.chip.registers()[PRESCALE], servos.chip.registers()[MODE1]) == (50, AWAKE)


def test_pca9685_takes_its_prescaler_only_asleep(servos):
    servos.write(PRESCALE, PRESCALE_50_HZ)
    assert servos.read(PRESCALE) == bytes([PRESCALE_50_HZ])
    servos.write(MODE1, AWAKE)
    servos.write(PRESCALE, 60)
    assert servos.read(PRESCALE) == bytes([PRESCALE_50_HZ])
    servos.write(MODE1, ASLEEP)
    servos.write(PRESCALE, 1)
    assert servos.read(PRESCALE) == b"\x03"  # the least that it takes


def test_pca9685_all_led_registers_write_all_and_read_zero(servos):
    servos.write(MODE1, ASLEEP)
    servos.write(ALL_LED, 0x12, 0x03, 0x45, 0x06)
    assert servos.chip.registers()[LED0 : LED0 + 64] == bytes([0x12, 0x03, 0x45, 0x06]) * 16
    assert servos.read(ALL_LED, 4) == bytes(4)


def test_pca9685_does_not_acknowledge_reserved_registers(servos):
    assert servos.repl.exec("print(i2c.writeto(0x40, b'\\x50\\x01'), i2c.writeto(0x40, b'\\x06\\x01'))") == "0 2\r\n"


def test_pca9685_answers_to_all_call_and_subaddresses(servos):
    assert servos.repl.exec("print(i2c.scan())") == "[64, 112]\r\n"
    servos.write(MODE1, 0x18)
    assert servos.repl.exec("print(i2c.scan())") == "[64, 113]\r\n"


def test_pca9685_is_reset_by_the_general_call(servos):
    servos.wake()
    servos.set(3, 0, 300)
    servos.mcu.run_for(30_000)
    servos.repl.exec("from machine import SoftI2C\nSoftI2C(sda=Pin(4), scl=Pin(5)).writeto(0, b'\\x06')")
    assert servos.chip.registers()[: LED0 + 64] == POWER_ON
    assert servos.after(3) == []


# ---- outputs


@pytest.mark.parametrize(
    "prescale, clock_hz", [(121, 25_000_000), (121, 26_312_000), (3, 25_000_000), (255, 24_100_000)]
)
def test_pca9685_period_and_widths_are_exact(pico, prescale, clock_hz):
    servos = Servos(pico, clock_hz)
    servos.wake(prescale)
    chosen = {0: (0, 1), 1: (0, 307), 7: (409, 1228), 14: (100, 4095), 15: (4095, 10)}
    for channel, (on, off) in chosen.items():
        servos.set(channel, on, off)
    servos.mcu.run_for(int(2 * servos.cycle_ns / 1000))
    for channel, (on, off) in chosen.items():
        edges = servos.after(channel)
        assert all(abs(width - (off - on) % CYCLE * servos.count_ns) <= 1 for width in widths(edges))
        assert len(widths(edges)) >= 2
        assert all(abs(b - a - servos.cycle_ns) <= 1 for a, b in itertools.pairwise(rises(edges)))


def test_pca9685_counts_from_500_us_after_waking(servos):
    servos.write(MODE1, ASLEEP)
    servos.write(PRESCALE, PRESCALE_50_HZ)
    servos.write(ALL_LED, *counts(0, 0))
    for channel in CHANNELS:
        servos.set(channel, 200 * channel, 200 * channel + 100)
    servos.repl.start(f"i2c.writeto_mem({ADDRESS}, {MODE1}, bytes([{AWAKE}]))")
    while servos.chip.registers()[MODE1] != AWAKE:
        servos.mcu.run_for(2)
    awake_ns = servos.mcu.now_us * 1000
    servos.mcu.run_for(100_000)
    first_ns = rises(servos.chip.edges(0))[0]
    assert awake_ns - 2_000 <= first_ns - WAKE_UP_US * 1000 <= awake_ns
    for channel in CHANNELS:
        assert rises(servos.chip.edges(channel))[0] == first_ns + 200 * channel * 122 * 40


@pytest.mark.parametrize(
    "on, off, level", [(FULL, 0, 1), (FULL | 9, 77, 1), (0, FULL, 0), (FULL, FULL, 0), (0, 0, 0), (55, 55, 0)]
)
def test_pca9685_full_on_full_off_and_equal_counts(servos, on, off, level):
    servos.wake()
    servos.set(5, 0, 2000)
    servos.mcu.run_for(50_000)
    servos.set(5, on, off)
    servos.mcu.run_for(45_000)
    assert servos.chip.edges(5)[-1][1] == level
    assert servos.after(5) == []


def test_pca9685_new_values_act_from_the_next_cycle_on(servos):
    servos.wake()
    servos.set(2, 0, 2000)
    servos.mcu.run_for(60_000)
    start_ns = rises(servos.chip.edges(2))[-1] + round(servos.cycle_ns)
    servos.mcu.run_until(start_ns // 1000 + 1000)
    servos.mcu.clear_edges()
    servos.set(2, 0, 300)
    assert servos.mcu.now_us * 1000 < start_ns + 2000 * servos.count_ns
    servos.mcu.run_for(50_000)
    fall, rise, next_fall = servos.chip.edges(2)[:3]
    assert fall == (start_ns + round(2000 * servos.count_ns), 0)
    assert rise == (start_ns + round(servos.cycle_ns), 1)
    assert next_fall == (rise[0] + round(300 * servos.count_ns), 0)


def test_pca9685_takes_values_over_at_stop(servos):
    servos.wake()
    servos.repl.exec(f"i2c.writeto({ADDRESS}, bytes([{LED0}, 0, 0, 100, 0]), False)")
    assert servos.chip.registers()[LED0 : LED0 + 4] == bytes([0, 0, 100, 0])
    servos.mcu.run_for(60_000)
    unfinished = servos.chip.edges(0)
    servos.repl.exec(f"i2c.readfrom({ADDRESS}, 1)")
    servos.mcu.run_for(60_000)
    assert unfinished == []
    assert len(widths(servos.chip.edges(0))) >= 2


def test_pca9685_takes_values_over_on_acknowledgement_if_told(servos):
    servos.wake()
    servos.set(1, 0, 200)
    servos.write(MODE2, ON_ACK)
    servos.repl.exec(f"i2c.writeto({ADDRESS}, bytes([{LED0}, 0, 0, 100, 0, 0, 0, 100]), False)")
    servos.mcu.run_for(60_000)
    assert len(widths(servos.chip.edges(0))) >= 2
    servos.repl.exec(f"i2c.readfrom({ADDRESS}, 1)")  # with a STOP
    servos.mcu.run_for(60_000)
    assert set(widths(servos.chip.edges(1))) == {200 * 122 * 40}  # only three of its registers were written


def test_pca9685_notices_the_stop_of_a_transfer_that_went_on_elsewhere(servos):
    servos.wake()
    servos.mcu.add_pca9685(0, ADDRESS + 1)
    servos.repl.exec(
        "from machine import SoftI2C\nsoft = SoftI2C(sda=Pin(4), scl=Pin(5))\n"
        f"soft.writeto({ADDRESS}, bytes([{LED0}, 0, 0, 100, 0]), False)\n"
    )
    servos.mcu.run_for(60_000)
    unfinished = servos.chip.edges(0)
    assert servos.repl.exec(f"print(soft.readfrom({ADDRESS + 1}, 1))") == "b'\\x11'\r\n"
    servos.mcu.run_for(60_000)
    assert unfinished == []
    assert len(widths(servos.chip.edges(0))) >= 2


# ---- sleep, OE, power


def test_pca9685_restarts_after_sleep_when_told(servos):
    servos.wake()
    servos.set(4, 0, 300)
    servos.mcu.run_for(60_000)
    servos.write(MODE1, ASLEEP)
    assert servos.read(MODE1) == bytes([ASLEEP | RESTART])
    assert servos.after(4) == []
    servos.write(MODE1, AWAKE | RESTART)  # too early: the oscillator is not up
    servos.mcu.run_for(WAKE_UP_US)
    assert servos.read(MODE1) == bytes([AWAKE | RESTART])
    assert servos.after(4) == []
    servos.write(MODE1, AWAKE | RESTART)
    assert servos.read(MODE1) == bytes([AWAKE])
    assert set(widths(servos.after(4))) == {300 * 122 * 40}


def test_pca9685_restarts_after_sleep_when_values_are_written(servos):
    servos.wake()
    servos.set(4, 0, 300)
    servos.write(MODE1, ASLEEP)
    servos.wake()
    servos.set(4, 0, 400)
    assert servos.read(MODE1) == bytes([AWAKE])
    servos.mcu.run_for(20_000)
    assert set(widths(servos.after(4))) == {400 * 122 * 40}


def test_pca9685_has_nothing_to_restart_after_an_orderly_shutdown(servos):
    servos.wake()
    servos.set(4, 0, 300)
    servos.write(ALL_LED, *counts(0, FULL))
    servos.write(MODE1, ASLEEP)
    assert servos.read(MODE1) == bytes([ASLEEP])


def test_pca9685_oe_silences_all_outputs_at_once(servos):
    servos.wake()
    servos.write(ALL_LED, *counts(FULL, 0))
    servos.mcu.run_for(30_000)
    servos.mcu.clear_edges()
    servos.repl.exec("oe = Pin(6, Pin.OUT, value=1)")
    (high,) = servos.mcu.edges(OE_PIN)
    for channel in CHANNELS:
        assert servos.chip.edges(channel) == [(high[0], 0)]
    servos.repl.exec("oe(0)")
    assert [level for _, level in servos.chip.edges(9)] == [0, 1]
    servos.mcu.clear_edges()
    servos.repl.exec("oe.init(Pin.IN, None)")
    assert servos.chip.edges(9) == []  # nobody drives OE: low
    servos.mcu.set_pin(OE_PIN, 1)
    assert [level for _, level in servos.chip.edges(9)] == [0]


def test_pca9685_oe_follows_mode2(servos):
    servos.wake()
    servos.repl.exec("oe = Pin(6, Pin.OUT, value=1)")
    servos.write(MODE2, 0x05)
    assert servos.chip.edges(0)[-1][1] == 1
    servos.write(MODE2, 0x06)
    assert servos.chip.edges(0)[-1][1] == 0  # not driven
    servos.repl.exec("oe(0)")
    servos.write(MODE2, 0x14)
    assert servos.chip.edges(0)[-1][1] == 1  # inverted


def test_pca9685_without_oe_pin_is_always_enabled(pico):
    chip = pico.add_pca9685(1, ADDRESS)
    repl = RawRepl(pico)
    repl.exec("from machine import I2C, Pin\ni2c = I2C(1, sda=Pin(2), scl=Pin(3))\nPin(6, Pin.OUT, value=1)")
    repl.exec("i2c.writeto_mem(0x40, 0, b'\\x21'); i2c.writeto_mem(0x40, 6, bytes((0, 0, 0, 8)))", timeout_us=1_000_000)
    pico.run_for(50_000)
    assert len(widths(chip.edges(0))) >= 2


def test_pca9685_that_loses_its_supply_comes_back_as_after_power_on(servos):
    servos.wake()
    servos.write(ALL_LED, *counts(FULL, 0))
    servos.mcu.run_for(30_000)
    servos.mcu.clear_edges()
    servos.chip.remove()
    lost_ns = servos.mcu.now_us * 1000
    assert all(servos.chip.edges(channel) == [(lost_ns, 0)] for channel in CHANNELS)
    assert servos.repl.exec("print(i2c.scan())") == "[]\r\n"
    servos.chip.put_back()
    assert servos.repl.exec("print(i2c.scan())") == "[64, 112]\r\n"
    assert servos.chip.registers()[: LED0 + 64] == POWER_ON
    assert servos.after(0) == []


def test_pca9685_goes_on_while_the_rp2040_resets(servos):
    servos.wake()
    servos.set(0, 0, 300)
    servos.mcu.run_for(30_000)
    servos.mcu.clear_edges()
    servos.mcu.send(b"import machine; machine.reset()\x04")
    servos.mcu.run_for(300_000)
    assert servos.mcu.report()["resets"] == 1
    edges = servos.chip.edges(0)
    assert set(widths(edges)) == {300 * 122 * 40}
    assert {b - a for a, b in itertools.pairwise(rises(edges))} == {CYCLE * 122 * 40}


def test_pca9685_outputs_are_0_to_15(servos):
    for channel in (-1, 16):
        with pytest.raises(ValueError, match="0 to 15"):
            servos.chip.edges(channel)


def test_pca9685_edges_do_not_depend_on_when_they_are_read(rp2040_image_path):
    def run(looks):
        with Rp2040Mcu(rp2040_image_path, timed_flash=False) as mcu:
            servos = Servos(mcu, 25_700_000)
            servos.wake()
            servos.write(LED0, *itertools.chain(*(counts(7 * i, 3000 - 150 * i) for i in CHANNELS)))
            end_us = mcu.now_us + 100_000
            while mcu.now_us < end_us:
                mcu.run_until(min(mcu.now_us + 100_000 // looks, end_us))
                all_edges = [servos.chip.edges(channel) for channel in CHANNELS]
            return all_edges

    assert run(1) == run(170)
