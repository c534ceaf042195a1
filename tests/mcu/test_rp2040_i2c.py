"""The I2C buses of the emulated RP2040: transfers, their time, devices that come and go, a bus that is stuck.

The oracle for times is the RP2040 data sheet, section 4.3.14.1, with the counts that pico-sdk's `i2c_set_baudrate` chooses.
"""

import pytest

from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu

ADDRESS = 0x40
ENODEV, EIO, ETIMEDOUT = 19, 5, 110
SETUP = """
from machine import I2C, Pin
import time
def attempt(action, *arguments):
    start = time.ticks_us()
    try:
        result = action(*arguments)
    except OSError as error:
        result = 'E%d' % error.errno
    print(result, time.ticks_diff(time.ticks_us(), start))
"""
WAKE = "i2c.writeto_mem(0x40, 0, b'\\x21'); time.sleep_ms(1)\n"


def open_bus(repl, bus=0, freq=400_000, sda=4, scl=5, timeout_us=50_000):
    repl.exec(SETUP + f"i2c = I2C({bus}, sda=Pin({sda}), scl=Pin({scl}), freq={freq}, timeout={timeout_us})")


def attempt(repl, action):
    """The result of an action on the MCU, `E` and a number for an OSError, and how many microseconds it took."""
    result, took_us = repl.exec(f"attempt({action})").rsplit(" ", 1)
    return result, int(took_us)


def bit_ns(freq):
    """SCL's period: what the registers of the controller make of a frequency at 125 MHz."""
    period = (125_000_000 + freq // 2) // freq
    low = period * 3 // 5
    high = period - low
    spikes = 1 if low < 16 else low // 16
    return 8 * ((high + spikes + 7) + (low + 1))


@pytest.mark.parametrize("bus, sda, scl", [(0, 4, 5), (0, 0, 1), (0, 20, 21), (1, 2, 3), (1, 26, 27)])
def test_i2c_reads_and_writes_on_each_bus(repl, bus, sda, scl):
    repl.mcu.add_pca9685(bus, ADDRESS)
    repl.mcu.add_pca9685(1 - bus, ADDRESS + 1)
    open_bus(repl, bus, sda=sda, scl=scl)
    assert repl.exec("print([hex(address) for address in i2c.scan()])") == "['0x40', '0x70']\r\n"
    assert repl.exec("print(i2c.writeto(0x40, b'\\x00\\x31'))") == "2\r\n"
    assert repl.exec("print(i2c.readfrom_mem(0x40, 0, 6).hex())") == "3104e2e4e8e0\r\n"
    repl.exec("i2c.writeto_mem(0x40, 2, b'\\x10\\x12')")
    assert repl.exec("print(i2c.writeto(0x40, b'\\x01', False), i2c.readfrom(0x40, 3).hex())") == "1 041012\r\n"


def test_i2c_transfer_without_data_is_acknowledged_by_who_is_there(repl):
    repl.mcu.add_pca9685(0, ADDRESS)
    open_bus(repl)
    assert attempt(repl, "i2c.writeto, 0x40, b''")[0] == "0"
    assert attempt(repl, "i2c.writeto, 0x41, b''")[0] == f"E{ENODEV}"
    assert repl.exec("print(i2c.readfrom_mem(0x40, 1, 1))") == "b'\\x04'\r\n"  # the controller has its pins again


@pytest.mark.parametrize(
    "action", ["i2c.writeto, 0x41, b'ab'", "i2c.readfrom, 0x41, 2", "i2c.readfrom_mem, 0x41, 0, 2"]
)
def test_i2c_absent_address_is_an_error_at_once(repl, action):
    repl.mcu.add_pca9685(0, ADDRESS)
    open_bus(repl)
    result, took_us = attempt(repl, action)
    assert result == f"E{EIO}"
    assert took_us < 400


@pytest.mark.parametrize("freq", [100_000, 400_000, 1_000_000])
def test_i2c_burst_takes_its_time(repl, freq):
    # Address, register and 64 bytes of 9 bits each, START and STOP; between two bytes the SDK takes 1 to 4 us to see that
    # one is gone and to hand over the next, with SCL held low.
    repl.mcu.add_pca9685(0, ADDRESS)
    open_bus(repl, freq=freq)
    repl.exec("burst = bytearray(65); burst[0] = 6")
    result, took_us = attempt(repl, "i2c.writeto, 0x40, burst")
    wire_us = (66 * 9 + 2) * bit_ns(freq) / 1000
    assert result == "65"
    assert wire_us < took_us < wire_us + 65 * 4 + 60


def test_i2c_read_longer_than_the_fifo(repl):
    repl.mcu.add_pca9685(0, ADDRESS)
    open_bus(repl)
    repl.exec(WAKE)
    assert repl.exec("print(i2c.readfrom_mem(0x40, 6, 64).hex())") == "00000010" * 16 + "\r\n"


def start_burst(repl):
    """A burst on its way to a PCA9685 that is awake; returns when some 30 of its 66 bytes have passed."""
    repl.exec(WAKE + "burst = bytearray([6] + [0, 0, 0, 1] * 16)")
    repl.start("attempt(i2c.writeto, 0x40, burst)")
    while repl.chip.registers()[9] != 1:  # the first channel has not arrived yet
        repl.mcu.run_for(10)
    repl.mcu.run_for(600)


@pytest.fixture
def burst(rp2040_image_path):
    with Rp2040Mcu(rp2040_image_path, timed_flash=False) as mcu:
        repl = RawRepl(mcu)
        repl.chip = mcu.add_pca9685(0, ADDRESS)
        open_bus(repl)
        start_burst(repl)
        yield repl


def test_i2c_device_removed_in_a_transfer_stops_acknowledging(burst):
    # MicroPython reports that as fewer bytes, not as an error (pico-sdk: ABRT_TXDATA_NOACK gives the count).
    burst.chip.remove()
    count, _ = burst.finish().split()
    assert 20 < int(count) < 60
    assert attempt(burst, "i2c.writeto, 0x40, burst")[0] == f"E{EIO}"
    burst.chip.put_back()
    assert attempt(burst, "i2c.writeto, 0x40, burst")[0] == "65"


def test_i2c_bus_stuck_in_a_transfer_times_out(burst):
    burst.mcu.set_i2c_stuck(0, True)
    result, took_us = burst.finish().split()
    assert result == f"E{ETIMEDOUT}"
    assert 50_000 <= int(took_us) < 52_000
    assert set(burst.chip.registers()[6 + 32 : 6 + 64 : 4]) == {0}
    burst.mcu.set_i2c_stuck(0, False)
    assert attempt(burst, "i2c.writeto, 0x40, burst")[0] == "65"


def test_i2c_bus_comes_free_in_a_transfer(burst):
    burst.mcu.run_for(40_000)
    burst.finish()
    burst.mcu.set_i2c_stuck(0, True)
    burst.start("attempt(i2c.writeto, 0x40, burst)")
    burst.mcu.run_for(20_000)
    burst.mcu.set_i2c_stuck(0, False)
    result, took_us = burst.finish().split()
    assert result == "65"
    assert 20_000 < int(took_us) < 24_000


@pytest.mark.parametrize("timeout_us", [1_000, 20_000])
def test_i2c_stuck_bus_times_out_and_recovers(repl, timeout_us):
    repl.mcu.add_pca9685(1, ADDRESS)
    open_bus(repl, 1, sda=6, scl=7, timeout_us=timeout_us)
    repl.mcu.set_i2c_stuck(1, True)
    for action in ("i2c.writeto, 0x40, b'\\x00\\x31'", "i2c.readfrom, 0x40, 2"):
        result, took_us = attempt(repl, action)
        assert result == f"E{ETIMEDOUT}"
        assert timeout_us <= took_us < timeout_us + 500
    assert repl.exec("print(Pin(6, Pin.IN, Pin.PULL_UP).value())") == "0\r\n"
    repl.mcu.set_i2c_stuck(1, False)
    assert repl.exec("print(Pin(6, Pin.IN, Pin.PULL_UP).value())") == "1\r\n"
    open_bus(repl, 1, sda=6, scl=7, timeout_us=timeout_us)
    assert attempt(repl, "i2c.readfrom_mem, 0x40, 0, 1")[0] == "b'\\x11'"


def test_i2c_bit_banged_by_firmware_reads_and_writes(repl):
    repl.mcu.add_pca9685(0, ADDRESS)
    open_bus(repl)
    repl.exec("from machine import SoftI2C\nsoft = SoftI2C(sda=Pin(4), scl=Pin(5), freq=100000)")
    assert repl.exec("print(soft.scan())") == "[64, 112]\r\n"
    assert (
        repl.exec("print(soft.writeto(0x40, b'\\x00\\x31'), soft.readfrom_mem(0x40, 0, 6).hex())")
        == "2 3104e2e4e8e0\r\n"
    )


def test_i2c_runs_repeat_in_whatever_pieces(rp2040_image_path):
    def run(piece_us):
        with Rp2040Mcu(rp2040_image_path, timed_flash=False) as mcu:
            chip = mcu.add_pca9685(0, ADDRESS, 6)
            repl = RawRepl(mcu)
            open_bus(repl)
            repl.start(
                WAKE + "for width in range(200, 240):\n"
                "    i2c.writeto_mem(0x40, 6, bytes((0, 0, width, 0)))\n    time.sleep_us(1717)\n"
            )
            end_us = mcu.now_us + 200_000
            while mcu.now_us < end_us:
                mcu.run_until(min(mcu.now_us + piece_us, end_us))
            return chip.edges(0), chip.registers(), mcu.state(), mcu.receive()

    first = run(200_000)
    assert len(first[0]) > 20
    assert run(777) == first


@pytest.mark.parametrize("bus, address, oe_pin, clock_hz", [(2, 0x40, None, 25e6), (0, 7, None, 25e6), (0, 0x78, None, 25e6),
                                                            (0, 0x40, 30, 25e6), (0, 0x40, None, 0)])  # fmt: skip
def test_i2c_device_that_cannot_be_is_refused(pico, bus, address, oe_pin, clock_hz):
    with pytest.raises(ValueError, match="must be"):
        pico.add_pca9685(bus, address, oe_pin, clock_hz)
    with pytest.raises(ValueError, match="must be"):
        pico.set_i2c_stuck(2, True)
