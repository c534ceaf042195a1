"""Fixed-point formats, codes and sizes that both halves agree on.

`_qN` is an integer in which 1.0 is `1 << N`. The firmware's kernels repeat the numbers they compute with as
`const`, because viper inlines constants of its own file only; a test holds them against this table.

Unit values: every DOF's value travels as `value_q15`, 0..32768. An absolute DOF's 0..1 is that number divided by
32768; a relative DOF's -1..1 is shifted and halved first, so that 16384 stands still. The convex sum does not mind,
being affine, and nothing in the compositor can become negative.
"""

VALUE_BITS = 15  # values of DOFs and functions, 0..1 inclusive
WEIGHT_BITS = 28  # weights, weight targets and live channels, 0..4
ALPHA_BITS = 26  # filter coefficients 1 - exp(-1 / (F * tau))
TEMPO_BITS = 16  # tempos, rounded when read (SPEC of time: multiples of 1/65536)
GAIN_BITS = 16  # gains of bands, -4..4; they travel and are kept as `gain4_q16`, that is gain + 4, which is never negative
PHASE_BITS = 24  # fraction of a cycle; whole cycles are kept modulo 4096 beside it
PULSE_BITS = 4  # pulse widths in 1/16 us
POSITION_BITS = 24  # positions inside the motor layer, 0..1 like values; speeds and accelerations per tick
RESPONSE_BITS = 24  # coefficients of a character's response

VALUE_ONE = 1 << VALUE_BITS
WEIGHT_ONE = 1 << WEIGHT_BITS
WEIGHT_MAX = 4 * WEIGHT_ONE
ALPHA_ONE = 1 << ALPHA_BITS
TEMPO_ONE = 1 << TEMPO_BITS
GAIN_ONE = 1 << GAIN_BITS
GAIN4_ONE = 5 << GAIN_BITS  # a gain of 1
GAIN4_MAX = 8 << GAIN_BITS
POSITION_ONE = 1 << POSITION_BITS
RESPONSE_ONE = 1 << RESPONSE_BITS
CYCLES = 4096  # all functions repeat after so many periods
SNAP_Q28 = 1 << 10  # 2^-18: a weight this near to its target is set to it
FAINT_Q28 = 1 << 20  # 1/256: below it a weight counts as faint

BANDS = 7  # of signal processing, the highest first

DOFS_MAX = 16
ACTIONS_MAX = 64
MAPPINGS_MAX = 512
LIVES_MAX = 16
CURVES_MAX = 64
SAMPLES_MAX = 256  # of one curve
SAMPLES_POOL = 3072  # of all curves of a puppet
BLINKS_MAX = 128
DEVICES_MAX = 4  # chips that outputs share
DEVICE_SETTINGS_MAX = 8
SETTINGS_MAX = 6  # of an output
FRAMES_KEPT = 16  # frames whose taps are kept until their motor tap is known
QUEUE_MAX = 256  # stamped targets that wait for their frame
NOISE_TABLES = 16
GRADIENTS = 256  # per noise table

FRAME_RATE_MIN_HZ = 10
FRAME_RATE_MAX_HZ = 60
TEMPO_MIN_Q16 = 3277  # 0.05
TEMPO_MAX_Q16 = 8 * TEMPO_ONE
MASTER_TEMPO_MIN_Q16 = TEMPO_ONE // 4
MASTER_TEMPO_MAX_Q16 = 4 * TEMPO_ONE
VARIANCE_MAX_Q16 = 1 << 27  # process and noise of a live channel that is predicted, in a unit of their own

# The motor layer's own rate: one tick every so many microseconds, a multiple of MOTOR_PERIOD_STEP_US.
MOTOR_PERIOD_MIN_US = 3008
MOTOR_PERIOD_MAX_US = 20000
MOTOR_PERIOD_STEP_US = 8
TURNS_MAX = 64  # an output is written every so many ticks, and that is its PWM period
PWM_PERIOD_MAX_US = 20971  # 65535 counts of 0.32 us
ATTACH_MAX_MS = 2000
STAND_MS = 250  # a relative DOF has to get from full speed to a stand in so long
RESPONSE_MAX_Q24 = 16 * RESPONSE_ONE  # of each coefficient, either sign
STORE_MAX = 48 * 1024  # bytes kept on the MCU's flash

PULSE_MIN_US = 300
PULSE_MAX_US = 3000
PULSE_GAP_US = 200  # what a pulse leaves of its period at least
SERVO_PERIOD_US = 20000

# Function codes of a mapping. Its `argument` is, in this order: nothing, nothing, the noise table 0..15, a value_q15, a
# live channel, a curve, a program, a blink, a blink.
FUNCTION_RSIN = 0
FUNCTION_RCOS = 1
FUNCTION_NOISE = 2
FUNCTION_CONST = 3
FUNCTION_LIVE = 4
FUNCTION_CURVE = 5
FUNCTION_PROGRAM = 6
FUNCTION_BLINK = 7
FUNCTION_RTRIGSIN = 8

# How an action enters: in step with the master clock, or at its own beginning.
ENTRY_SYNC = 0
ENTRY_START = 1
CYCLES_MAX = 1000  # of a gesture

# Kinds of DOF.
KIND_ABSOLUTE = 0
KIND_RELATIVE = 1

# How the future of a live channel is predicted: its target stays, or goes on at its estimated velocity.
PREDICT_HOLD = 0
PREDICT_KALMAN = 1

# Drivers of outputs, and what an output or device without one has.
DRIVER_PINS = 0
DRIVER_PCA9685 = 1
DRIVER_BRIDGE = 2
NO_DRIVER = 255

# What the puppet does when the link is silent; relative DOFs stand in any case.
SILENT_IDLE = 0  # it goes on
SILENT_REST = 1  # it glides to rest
SILENT_RELAX = 2  # it glides to rest, and each DOF is let go when it is there

# Who took the pulses away last.
KILLED_BY_NOBODY = 0
KILLED_BY_HOST = 1
KILLED_BY_PIN = 2
KILLED_BY_STOPPED_TICKS = 3

# What became of the file on the MCU's flash when it was switched on.
STORE_NONE = 0
STORE_PLAYED = 1
STORE_DAMAGED = 2

NEW = 255  # in `keep`: an action, DOF or live channel that was not there before
KEEP_ACTIONS = 0  # kinds of `keep`
KEEP_DOFS = 1
KEEP_LIVES = 2
FRAME_NOW = -1  # stamp of a target that acts in the next frame, whichever it is
MASTER = 255  # the `action` of a tempo message that means the master tempo
NO_PIN = 255  # the pin of what has none
FEEDBACK_PIN_FIRST = 26  # the pins that measure
FEEDBACK_PIN_LAST = 28
FEEDBACK_SPAN_MIN_Q15 = VALUE_ONE // 64  # how far apart a feedback's ends have to be

# Taps of a frame, as bits of the taps message.
TAP_BASE = 1
TAP_SIGNAL = 2
TAP_MOTOR = 4
TAP_DERIVATIVES = 8  # asks for `derivatives` too
