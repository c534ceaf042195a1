"""The message dictionary: every message of the link, declared once.

Each entry is `(name, id, fields, items)`. `fields` are the `(name, type)` pairs at fixed places of the payload; `items`
are the pairs that repeat until the payload ends (empty if nothing repeats). Types are those of `struct`, little-endian:
B, H, I unsigned of 8, 16, 32 bits, i signed of 32. Names end in format or unit (`_q15`, `_q28`, `_us`); the rest are
counts, indices and flags. Ids below 128 go to the MCU and are acknowledged, those from 128 up come from it and are
not. No id is 3: a packet's first byte is its id, and `0D 03` at the start of a packet calls the REPL (see codec).

PROTOCOL counts changes of meaning; the checksum of this dictionary catches changes of layout by itself. Both are
exchanged by `hello` and `welcome`, whose layout, with that of `ack`, never changes.
"""

PROTOCOL = 6  # 1 to 5 are control characters of MicroPython's REPL: a greeting must not interrupt or restart what it meets

HELLO = 0x10
PING = 0x11
BEGIN = 0x12
DOF = 0x13
OUTPUT = 0x14
ACTION = 0x15
MAPPINGS = 0x16
LIVE = 0x17
CURVE = 0x18
PROGRAM = 0x19
BLINK = 0x1A
KEEP = 0x1B
COMMIT = 0x1F
START = 0x20
STOP = 0x21
WEIGHT_TARGETS = 0x22
LIVE_TARGETS = 0x23
TEMPO = 0x24
GAINS = 0x25
ARM = 0x28
KILL = 0x29
TELEMETRY = 0x2A
STATUS_REQUEST = 0x2B
ROBOT = 0x2C
DEVICE = 0x2D
CHARACTER = 0x2E
FEEDBACK = 0x2F
GUARD = 0x30
CALIBRATE = 0x31
LIMIT = 0x32
SAVE_BEGIN = 0x33
SAVE = 0x34
SAVE_END = 0x35
SAVE_ERASE = 0x36
WELCOME = 0x80
ACK = 0x81
TAPS = 0x82
WEIGHTS = 0x83
STATUS = 0x84
DERIVATIVES = 0x85
MOTOR_STATUS = 0x86

MESSAGES = (
    # --- to the MCU: the session
    ("hello", HELLO, (("protocol", "H"), ("dictionary", "I")), ()),
    ("ping", PING, (), ()),
    # --- to the MCU: a puppet's tables, into the staging area, then all at once
    (
        "begin",
        BEGIN,
        (
            ("frame_rate_hz", "B"),
            ("dofs", "B"),
            ("actions", "B"),
            ("mappings", "H"),
            ("lives", "B"),
            ("curves", "B"),
            ("programs", "B"),
            ("blinks", "B"),
            ("seed", "I"),
            ("noise_spread_q15", "H"),
            ("hold_q26", "I"),
            ("link_timeout_ms", "H"),
            ("when_silent", "B"),
        ),
        (),
    ),
    (
        "robot",
        ROBOT,
        (
            ("motor_period_us", "H"),
            ("attach_ms", "H"),
            ("kill_pin", "B"),
            ("kill_level", "B"),
            ("autostart", "B"),
        ),
        (),
    ),
    ("device", DEVICE, (("device", "B"), ("driver", "B")), (("setting", "H"),)),
    (
        "dof",
        DOF,
        (
            ("dof", "B"),
            ("kind", "B"),
            ("rest_q15", "H"),
            ("low_q15", "H"),
            ("high_q15", "H"),
            ("speed_q24", "I"),
            ("accel_q24", "I"),
            ("signal", "B"),
        ),
        (),
    ),
    (
        "character",
        CHARACTER,
        (
            ("dof", "B"),
            ("position_error_q24", "i"),
            ("position_rate_q24", "i"),
            ("position_slope_q24", "i"),
            ("rate_error_q24", "i"),
            ("rate_rate_q24", "i"),
            ("rate_slope_q24", "i"),
        ),
        (),
    ),
    (
        "output",
        OUTPUT,
        (
            ("dof", "B"),
            ("driver", "B"),
            ("turns", "B"),
            ("end0_q4us", "H"),
            ("end1_q4us", "H"),
            ("dead_q15", "H"),
            ("top_q15", "H"),
        ),
        (("setting", "H"),),
    ),
    (
        "feedback",
        FEEDBACK,
        (
            ("dof", "B"),
            ("pin", "B"),
            ("at0_q15", "H"),
            ("at1_q15", "H"),
            ("gain_q15", "H"),
            ("integral_q24", "I"),
            ("most_q15", "H"),
            ("stall_q15", "H"),
            ("stall_ticks", "H"),
        ),
        (),
    ),
    ("guard", GUARD, (("dof", "B"), ("release_ms", "H"), ("duty_q15", "H"), ("window_s", "H")), ()),
    (
        "action",
        ACTION,
        (
            ("action", "B"),
            ("tempo_q16", "I"),
            ("rise_q26", "I"),
            ("fall_q26", "I"),
            ("first_mapping", "H"),
            ("mappings", "B"),
            ("entry", "B"),
            ("warp_q26", "I"),
            ("cycles", "H"),
        ),
        (),
    ),
    (
        "mappings",
        MAPPINGS,
        (("first_mapping", "H"),),
        (("dof", "B"), ("function", "B"), ("argument", "H"), ("low_q15", "H"), ("high_q15", "H")),
    ),
    (
        "live",
        LIVE,
        (
            ("live", "B"),
            ("rest_q28", "I"),
            ("rise_q26", "I"),
            ("fall_q26", "I"),
            ("predict", "B"),
            ("process_q16", "I"),
            ("noise_q16", "I"),
            ("fade_q15", "H"),
        ),
        (),
    ),
    ("curve", CURVE, (("curve", "B"), ("samples", "H")), (("value_q15", "H"),)),
    ("program", PROGRAM, (("program", "B"), ("words", "H")), (("word", "i"),)),
    ("blink", BLINK, (("blink", "B"), ("threshold_q16", "I"), ("gap_q18", "I")), ()),
    ("keep", KEEP, (("kind", "B"), ("first", "B")), (("old", "B"),)),
    ("commit", COMMIT, (), ()),
    # --- to the MCU: the performance
    ("start", START, (), ()),
    ("stop", STOP, (), ()),
    ("weight_targets", WEIGHT_TARGETS, (("frame", "i"),), (("action", "B"), ("target_q28", "I"))),
    ("live_targets", LIVE_TARGETS, (("frame", "i"),), (("live", "B"), ("target_q28", "I"))),
    ("tempo", TEMPO, (("frame", "i"),), (("action", "B"), ("tempo_q16", "I"))),
    ("gains", GAINS, (("frame", "i"),), (("band", "B"), ("gain4_q16", "I"))),
    ("arm", ARM, (), ()),
    ("kill", KILL, (), ()),
    ("telemetry", TELEMETRY, (("taps", "B"), ("taps_every", "H"), ("weights_every", "H")), ()),
    ("status_request", STATUS_REQUEST, (), ()),
    # --- to the MCU: the tables that play
    (
        "calibrate",
        CALIBRATE,
        (("dof", "B"), ("end0_q4us", "H"), ("end1_q4us", "H"), ("dead_q15", "H"), ("top_q15", "H")),
        (),
    ),
    (
        "limit",
        LIMIT,
        (("dof", "B"), ("low_q15", "H"), ("high_q15", "H"), ("speed_q24", "I"), ("accel_q24", "I")),
        (),
    ),
    # --- to the MCU: what it keeps on its flash
    ("save_begin", SAVE_BEGIN, (("bytes", "I"), ("crc32", "I")), ()),
    ("save", SAVE, (("place", "I"),), (("byte", "B"),)),
    ("save_end", SAVE_END, (), ()),
    ("save_erase", SAVE_ERASE, (), ()),
    # --- from the MCU
    (
        "welcome",
        WELCOME,
        (
            ("protocol", "H"),
            ("dictionary", "I"),
            ("dofs_max", "B"),
            ("actions_max", "B"),
            ("mappings_max", "H"),
            ("lives_max", "B"),
            ("queue_max", "H"),
            ("frame", "i"),
            ("armed", "B"),
        ),
        (),
    ),
    ("ack", ACK, (("seq", "B"), ("status", "B"), ("detail", "H")), ()),
    ("taps", TAPS, (("frame", "i"), ("taps", "B")), (("value_q15", "H"),)),
    ("weights", WEIGHTS, (("frame", "i"),), (("action", "B"), ("weight_q12", "H"))),
    (
        "status",
        STATUS,
        (
            ("frame", "i"),
            ("armed", "B"),
            ("silent", "B"),
            ("late_max_us", "I"),
            ("late_frames", "I"),
            ("frame_max_us", "I"),
            ("packets", "I"),
            ("damaged", "I"),
            ("late_targets", "I"),
            ("refused_targets", "I"),
            ("heap_free", "I"),
            ("clipped", "I"),
            ("cut_short", "I"),
        ),
        (),
    ),
    ("derivatives", DERIVATIVES, (("frame", "i"),), (("slope_q16", "i"), ("bend_q15", "i"))),
    (
        "motor_status",
        MOTOR_STATUS,
        (
            ("ticks", "I"),
            ("late_frames", "I"),
            ("tick_max_us", "H"),
            ("tick_late_max_us", "H"),
            ("attached", "H"),
            ("released", "H"),
            ("stalled", "H"),
            ("killed_by", "B"),
            ("bus_errors", "I"),
            ("bus_gone", "B"),
            ("resets", "B"),
            ("store", "B"),
        ),
        (),
    ),
)

# Status of an acknowledgement; `detail` says which index, count or number was meant.
OK = 0
RESEND = 1  # a packet before this one is missing; detail: the sequence number that is expected
MISMATCH = 2  # hello: protocol or dictionary differ; the welcome that follows tells the MCU's
UNKNOWN = 3  # no such message; detail: its id
LENGTH = 4  # the payload has not the length of its message; detail: the length found
RANGE = 5  # a field is out of its range; detail: which field, counted from 0 (items go on after the fields)
INCOMPLETE = 6  # commit or save_end without all that was announced; detail: how many parts or bytes are missing
STATE = 7  # not possible now (start without tables, arm without outputs, save while armed or while the motion runs)
FULL = 8  # the queue of stamped targets is full; detail: its free places
FLASH = 9  # the flash could not be read or written; detail: the number of the error, as in errno

STATUS_TEXT = (
    "done",
    "a packet before it is missing",
    "protocol or message dictionary differ",
    "unknown message",
    "wrong length",
    "a field is out of range",
    "tables are incomplete",
    "not possible in this state",
    "the queue of stamped targets is full",
    "the flash could not be read or written",
)

_SIZES = {"B": 1, "H": 2, "I": 4, "i": 4}


def find(message_id):
    """Return the dictionary's entry for an id, or None."""
    for message in MESSAGES:
        if message[1] == message_id:
            return message
    return None


def size(pairs):
    """Return the bytes that a tuple of `(name, type)` pairs takes."""
    return sum(_SIZES[kind] for _, kind in pairs)


def offset(message_id, field):
    """Return the place of a field in its payload, or of an item's field within the item. Raises KeyError."""
    _, _, fields, items = find(message_id)
    for pairs in (fields, items):
        place = 0
        for name, kind in pairs:
            if name == field:
                return place
            place += _SIZES[kind]
    raise KeyError(field)


def struct_format(pairs):
    """Return the `struct` format of a tuple of pairs."""
    return "<" + "".join(kind for _, kind in pairs)


def length_fits(message, length):
    """Return whether a payload may have this length: the fields and a whole number of items."""
    rest = length - size(message[2])
    if not message[3]:
        return rest == 0
    return rest >= 0 and rest % size(message[3]) == 0


def canonical_text():
    """Return the text whose CRC-32 is the dictionary's checksum: one line a message, in the order declared."""
    lines = []
    for name, message_id, fields, items in MESSAGES:
        parts = [name, str(message_id)]
        parts.extend(kind + ":" + field for field, kind in fields)
        parts.append("*")
        parts.extend(kind + ":" + field for field, kind in items)
        lines.append(" ".join(parts))
    return "\n".join(lines)
