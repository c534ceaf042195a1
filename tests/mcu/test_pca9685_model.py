"""The PC's model of the PCA9685 against its data sheet (NXP, Rev. 4), as `test_rp2040_pca9685.py` has it for the emulator's."""

import itertools

import pytest

from marotte.mcu.pca9685 import CHANNELS, WAKE_NS, Pca9685Chip

CYCLE = 4096
MODE1, MODE2, LED0, ALL_LED, PRESCALE = 0, 1, 6, 0xFA, 0xFE
AWAKE, ASLEEP, RESTART = 0x21, 0x31, 0x80  # with auto-increment and the all-call address
ON_ACK = 0x0C
FULL = 0x1000
PRESCALE_50_HZ = 121
POWER_ON = bytes([0x11, 0x04, 0xE2, 0xE4, 0xE8, 0xE0]) + bytes([0, 0, 0, 0x10]) * CHANNELS


class Servos:
    """A chip and the instant it is."""

    def __init__(self, clock_hz=25_000_000):
        self.chip = Pca9685Chip(clock_hz)
        self.now_us = 0
        self.clock_hz = clock_hz

    def write(self, register, *values):
        self.chip.write(self.now_us, bytes([register, *values]))

    def wake(self, prescale=PRESCALE_50_HZ):
        self.write(MODE1, ASLEEP)
        self.write(PRESCALE, prescale)
        self.write(MODE1, AWAKE)
        self.now_us += WAKE_NS // 1000
        self.count_ns = (prescale + 1) * 1e9 / self.clock_hz
        self.cycle_us = CYCLE * self.count_ns / 1000

    def set(self, channel, on, off):
        self.write(LED0 + 4 * channel, on & 255, on >> 8, off & 255, off >> 8)

    def edges(self, channel):
        return self.chip.edges(self.now_us, channel)

    def after(self, channel):
        """Edges of the next three cycles."""
        self.chip.clear_edges(self.now_us)
        self.now_us += int(3 * self.cycle_us)
        return self.edges(channel)


@pytest.fixture
def servos():
    return Servos()


def rises(edges):
    return [t_ns for t_ns, level in edges if level]


def widths(edges):
    return [fall - rise for (rise, level), (fall, _) in itertools.pairwise(edges) if level]


def test_model_wakes_up_asleep_and_off(servos):
    assert servos.chip.registers()[: LED0 + 64] == POWER_ON
    assert servos.chip.registers()[PRESCALE] == 0x1E
    servos.now_us = 50_000
    assert all(servos.edges(channel) == [] for channel in range(CHANNELS))


def test_model_increments_its_register_only_if_told(servos):
    servos.write(LED0, 1, 2, 3, 4)
    assert servos.chip.registers()[LED0 : LED0 + 4] == bytes([4, 0, 0, 0x10])
    servos.write(MODE1, ASLEEP)
    servos.write(LED0, 1, 2, 3, 4)
    assert servos.chip.registers()[LED0 : LED0 + 4] == bytes([1, 2, 3, 4])
    servos.write(ALL_LED + 3, 0x10, 50, AWAKE)  # behind the prescaler comes MODE1
    assert (servos.chip.registers()[PRESCALE], servos.chip.registers()[MODE1]) == (50, AWAKE)
    servos.write(LED0 + 62, 7, 8, ASLEEP)  # as behind the last output
    assert servos.chip.registers()[MODE1] == ASLEEP


def test_model_takes_its_prescaler_only_asleep(servos):
    servos.write(PRESCALE, PRESCALE_50_HZ)
    servos.write(MODE1, AWAKE)
    servos.write(PRESCALE, 60)
    assert servos.chip.registers()[PRESCALE] == PRESCALE_50_HZ
    servos.write(MODE1, ASLEEP)
    servos.write(PRESCALE, 1)
    assert servos.chip.registers()[PRESCALE] == 3


def test_model_takes_nothing_behind_a_reserved_register(servos):
    servos.write(0x50, 1)
    assert servos.chip.registers()[0x50] == 0


@pytest.mark.parametrize(("prescale", "clock_hz"), [(121, 25e6), (121, 26.312e6), (3, 25e6), (255, 24.1e6)])
def test_model_has_exact_periods_and_widths(prescale, clock_hz):
    servos = Servos(clock_hz)
    servos.wake(prescale)
    chosen = {0: (0, 1), 1: (0, 307), 7: (409, 1228), 14: (100, 4095), 15: (4095, 10)}
    for channel, (on, off) in chosen.items():
        servos.set(channel, on, off)
    servos.now_us += int(2 * servos.cycle_us)
    for channel, (on, off) in chosen.items():
        edges = servos.after(channel)
        assert len(widths(edges)) >= 2
        assert all(abs(width - (off - on) % CYCLE * servos.count_ns) <= 1 for width in widths(edges))
        assert all(abs(b - a - CYCLE * servos.count_ns) <= 1 for a, b in itertools.pairwise(rises(edges)))


def test_model_counts_from_500_us_after_waking(servos):
    for channel in range(CHANNELS):
        servos.set(channel, 0, FULL)
    servos.wake()
    for channel in range(CHANNELS):
        servos.set(channel, 200 * channel, 200 * channel + 100)
    servos.now_us += 100_000
    for channel in range(CHANNELS):
        first_ns = WAKE_NS + round(CYCLE * servos.count_ns)
        assert rises(servos.edges(channel))[0] == first_ns + 200 * channel * 122 * 40


@pytest.mark.parametrize(
    ("on", "off", "level"), [(FULL, 0, 1), (FULL | 9, 77, 1), (0, FULL, 0), (FULL, FULL, 0), (0, 0, 0), (55, 55, 0)]
)
def test_model_knows_full_on_full_off_and_equal_counts(servos, on, off, level):
    servos.wake()
    servos.set(5, 0, 2000)
    servos.now_us += 50_000
    servos.set(5, on, off)
    servos.now_us += 45_000
    assert servos.edges(5)[-1][1] == level
    assert servos.after(5) == []


def test_model_takes_new_values_with_the_next_cycle(servos):
    servos.wake()
    servos.set(2, 0, 2000)
    servos.now_us += 60_000
    start_ns = rises(servos.edges(2))[-1] + round(CYCLE * servos.count_ns)
    servos.now_us = start_ns // 1000 + 1000
    servos.chip.clear_edges(servos.now_us)
    servos.set(2, 0, 300)
    servos.now_us += 50_000
    fall, rise, next_fall = servos.edges(2)[:3]
    assert fall == (start_ns + round(2000 * servos.count_ns), 0)
    assert rise == (start_ns + round(CYCLE * servos.count_ns), 1)
    assert next_fall == (rise[0] + round(300 * servos.count_ns), 0)


def test_model_takes_whole_channels_on_acknowledgement_if_told(servos):
    servos.wake()
    servos.write(MODE2, ON_ACK)
    servos.write(LED0, 0, 0, 100, 0, 0, 0, 100)
    servos.now_us += 60_000
    assert len(widths(servos.edges(0))) >= 2
    assert servos.edges(1) == []


def test_model_restarts_after_sleep_when_told(servos):
    servos.wake()
    servos.set(4, 0, 300)
    servos.now_us += 60_000
    servos.write(MODE1, ASLEEP)
    assert servos.edges(4)[-1][1] == 0
    assert servos.chip.registers()[MODE1] == ASLEEP | RESTART
    assert servos.after(4) == []
    servos.write(MODE1, AWAKE | RESTART)  # too early: the oscillator is not up
    servos.now_us += WAKE_NS // 1000
    assert servos.chip.registers()[MODE1] == AWAKE | RESTART
    assert servos.after(4) == []
    servos.write(MODE1, AWAKE | RESTART)
    assert servos.chip.registers()[MODE1] == AWAKE
    assert set(widths(servos.after(4))) == {300 * 122 * 40}


def test_model_has_nothing_to_restart_after_an_orderly_shutdown(servos):
    servos.wake()
    servos.set(4, 0, 300)
    servos.write(ALL_LED, 0, 0, 0, FULL >> 8)
    servos.write(MODE1, ASLEEP)
    assert servos.chip.registers()[MODE1] == ASLEEP


def test_oe_silences_all_outputs_of_the_model_at_once(servos):
    servos.wake()
    servos.write(ALL_LED, 0, FULL >> 8, 0, 0)
    servos.now_us += 30_000
    servos.chip.clear_edges(servos.now_us)
    servos.now_us += 17
    servos.chip.set_disabled(servos.now_us, True)
    for channel in range(CHANNELS):
        assert servos.edges(channel) == [(servos.now_us * 1000, 0)]
    servos.write(MODE2, 0x05)  # while disabled: high
    assert servos.edges(0)[-1][1] == 1
    servos.write(MODE2, 0x06)  # not driven
    assert servos.edges(0)[-1][1] == 0
    servos.chip.set_disabled(servos.now_us, False)
    assert servos.edges(0)[-1][1] == 1
    servos.write(MODE2, 0x14)  # inverted
    assert servos.edges(0)[-1][1] == 0


@pytest.mark.parametrize("how", ["supply", "general call"])
def test_model_forgets_everything_with_its_supply_and_on_a_reset(servos, how):
    servos.wake()
    servos.write(ALL_LED, 0, FULL >> 8, 0, 0)
    servos.now_us += 30_000
    servos.chip.clear_edges(servos.now_us)
    if how == "supply":
        servos.chip.set_power(servos.now_us, False)
        servos.now_us += 1000
        servos.chip.set_power(servos.now_us, True)
    else:
        servos.chip.general_call(servos.now_us, b"\x07")  # means nothing
        assert servos.edges(3) == []
        servos.chip.general_call(servos.now_us, b"\x06")
    assert [level for _, level in servos.edges(3)] == [0]
    assert servos.chip.registers()[: LED0 + 64] == POWER_ON
    assert servos.after(3) == []


def test_edges_of_the_model_do_not_depend_on_when_they_are_read():
    def run(looks):
        servos = Servos(25_700_000)
        servos.wake()
        for channel in range(CHANNELS):
            servos.set(channel, 7 * channel, 3000 - 150 * channel)
        for _ in range(looks):
            servos.now_us += 100_000 // looks
            found = [servos.edges(channel)[:] for channel in range(CHANNELS)]
        return found

    assert run(1) == run(200)
