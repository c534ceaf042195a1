"""What all drivers of outputs have in common.

A driver is one object for all outputs of its kind; it knows them by the number of their DOF. `level_q24` is the calibrated
level of each DOF, 0x800000 standing still for relative ones, `pulse_q18us` the pulse width in microseconds, `due` has the
bit of each DOF that is attached and whose turn it is. What the motor tick may call (`attach`, `release`, `write`, `quiet`)
allocates nothing and takes a bounded time.
"""


class Driver:
    """One kind of output."""

    in_tick = True
    """Whether it writes in the motor tick; if not, `flush` writes from the main loop."""

    pins: tuple = ()
    """The numbers of an output's settings that are pins."""

    device_pins: tuple = ()
    """The numbers of a device's settings that are pins."""

    def pwm(self, settings, place):
        """Return which of `pins` are PWM pins of the board; an output's settings begin at `settings[place]`."""
        return ()

    def check_device(self, settings, count):
        """Return None if `count` settings suit a device, else the number of the bad one."""
        return 0

    def check_output(self, tables, dof, settings, count):
        """Return None if `count` settings suit an output, else the number of the bad one. `Drivers` compares the pins."""
        return 0

    def period_us(self, tables, dof):
        """Return the period of an output's pulses: that of its turn among the motor ticks, if nothing else is said."""
        return tables.turns[dof] * tables.motor_period_us

    def prepare(self, tables):
        """Allocate what `load` needs."""

    def load(self, tables):
        """Serve the prepared tables; allocates nothing.

        Outputs that are gone fall silent; return the DOFs whose output goes on as it was, as bits.
        """
        return 0

    def attach(self, dof, until_us):
        """Let an output have pulses from the next write on. The next tick in which it is due comes in `until_us`."""

    def release(self, dof):
        """Take the pulses of one output away."""

    def write(self, level_q24, pulse_q18us, due):
        """In the motor tick: bring out what is due."""

    def flush(self, level_q24, pulse_q18us, due):
        """The same in the main loop, as soon as possible after the tick."""

    def quiet(self):
        """Take all pulses away, now."""

    def attend(self, now_us):
        """In the main loop, all the time: what has to be done again, or later."""

    def bus_errors(self):
        """Return how many transfers have failed."""
        return 0

    def bus_gone(self):
        """Return which devices do not answer, as bits."""
        return 0
