"""Firmware under CPython with checked integers: what is caught, and that the rest runs unchanged."""

from array import array
from textwrap import dedent

import pytest

from tests.checked import IntegerRange, Pointer, extremes, load_checked

HIGH_32, HIGH_31 = 2**31 - 1, 2**30 - 1


@pytest.fixture
def load(tmp_path):
    """Load a source text as a checked module."""

    def load_text(text, **options):
        path = tmp_path / "kernel.py"
        path.write_text("import micropython\nfrom micropython import const\n" + dedent(text))
        return load_checked(path, root=tmp_path, **options)

    return load_text


def viper(body, arguments="a: int, b: int", result="int"):
    indented = "\n".join("    " + line for line in dedent(body).strip().splitlines())
    return f"@micropython.viper\ndef kernel({arguments}) -> {result}:\n{indented}\n"


@pytest.mark.parametrize(
    ("expression", "a", "b", "expected"),
    [
        ("a + b", HIGH_32 - 1, 1, HIGH_32),
        ("a - b", -HIGH_32, 1, -HIGH_32 - 1),
        ("a * b", 46340, 46340, 46340**2),
        ("a << b", 1, 30, 2**30),
        ("a >> b", -7, 1, -4),
        ("a // b", -7, 2, -4),
        ("a % b", -7, 4, 1),
        ("-a", HIGH_32, 0, -HIGH_32),
        ("~a", HIGH_32, 0, -HIGH_32 - 1),
        ("a ^ b", -1, 5, -6),
        ("a if 0 <= a < b else b", 3, 5, 3),
        ("int(a) + int(b)", 3, 5, 8),
    ],
)
def test_viper_arithmetic_within_32_bits_is_pythons(load, expression, a, b, expected):
    assert load(viper(f"return {expression}")).kernel(a, b) == expected


@pytest.mark.parametrize(
    ("expression", "a", "b"),
    [
        ("a + b", HIGH_32, 1),
        ("a - b", -HIGH_32, 2),
        ("a * b", 65536, 32768),
        ("a << b", 1, 31),
        ("a << b", 1, 32),
        ("a >> b", 1, -1),
        ("-a", -HIGH_32 - 1, 0),
        ("(a * b) >> 16", 65536, 65536),
        ("(a + b) - b", HIGH_32, 1),
        ("a", HIGH_32 + 1, 0),
        ("a", 0, -HIGH_32 - 2),
        ("a // b", -HIGH_32 - 1, -1),
    ],
)
def test_viper_integer_that_leaves_32_bits_raises(load, expression, a, b):
    with pytest.raises(IntegerRange, match="kernel"):
        load(viper(f"return {expression}")).kernel(a, b)


def test_error_tells_file_line_function_and_expression(load):
    with pytest.raises(IntegerRange, match=r"kernel\.py:5 in kernel: a \* b gives 4294967296, outside -2147483648"):
        load(viper("return (a * b) >> 16")).kernel(65536, 65536)


def test_plain_integers_inside_a_kernel_are_checked_too(load):
    module = load(
        """
        _ONE = const(1 << 16)
        @micropython.viper
        def kernel(count: int) -> int:
            total = 0
            for i in range(count):
                total += _ONE * i
            return total
        """
    )
    assert module.kernel(256) == 65536 * 255 * 128
    with pytest.raises(IntegerRange, match=r"total \+ _ONE \* i"):
        module.kernel(300)


def test_limit_of_31_bits_holds_for_viper_where_asked(load):
    text = viper("return a + b")
    assert load(text).kernel(HIGH_31, 1) == 2**30
    with pytest.raises(IntegerRange):
        load(text, limit_bits=31).kernel(HIGH_31, 1)


def test_bytecode_is_checked_by_name_and_for_small_ints(load):
    text = """
    class Clock:
        def __init__(self):
            self.now = 2**29

        def tick(self, step):
            self.now += step * 2
            return "%d" % self.now

        def setup(self):
            return self.now * 0x9E3779B1
    """
    clock = load(text, bytecode=["Clock.tick"]).Clock()
    assert clock.setup() == 2**29 * 0x9E3779B1
    assert clock.tick(1) == str(2**29 + 2)
    with pytest.raises(IntegerRange, match=r"Clock\.tick: self\.now \+ step \* 2"):
        clock.tick(2**28)
    assert load(text).Clock().tick(2**40) == str(2**29 + 2**41)


def test_patterns_fold_bit_operations_to_32_signed_bits(load):
    text = viper("a ^= (a & 0x7FFFF) << 13\na ^= (a >> 17) & 0x7FFF\na ^= (a & 0x7FFFFFF) << 5\nreturn a", "a: int")
    with pytest.raises(IntegerRange):
        load(text).kernel(0x7FFFF)
    kernel = load(text, patterns=["kernel"]).kernel
    state = signed = 1999
    for _ in range(1000):
        state ^= state << 13 & 0xFFFFFFFF
        state ^= state >> 17
        state ^= state << 5 & 0xFFFFFFFF
        signed = kernel(signed)
        assert signed & 0xFFFFFFFF == state
    with pytest.raises(IntegerRange):
        load(viper("return a + b"), patterns=["kernel"]).kernel(HIGH_32, 1)


@pytest.mark.parametrize(
    ("pointer", "memory", "expected"),
    [
        ("ptr8", b"\x01\xff", 255),
        ("ptr8", array("b", [0, -1]), 255),
        ("ptr16", b"\x00\x00\xfe\xff", 65534),
        ("ptr16", array("h", [0, -2]), 65534),
        ("ptr16", array("H", [0, 65534]), 65534),
        ("ptr32", array("i", [0, -7]), -7),
        ("ptr32", array("I", [0, 2**32 - 7]), -7),
        ("ptr32", bytearray(b"\x00\x00\x00\x00\xf9\xff\xff\xff"), -7),
        ("ptr32", memoryview(array("i", [9, 0, -7]))[1:], -7),
        ("ptr32", [0, -7], -7),
    ],
)
def test_pointers_read_elements_as_32_bit_hardware_does(load, pointer, memory, expected):
    assert load(viper("return int(x[1])", f"x: {pointer}")).kernel(memory) == expected
    assert load(viper(f"p = {pointer}(x)\nreturn p[1]", "x")).kernel(memory) == expected


@pytest.mark.parametrize("pointer", ["ptr8", "ptr16", "ptr32"])
@pytest.mark.parametrize("index", [-1, 4])
def test_index_outside_the_array_raises(load, pointer, index):
    memory = array({"ptr8": "B", "ptr16": "H", "ptr32": "i"}[pointer], range(4))
    with pytest.raises(IndexError, match=f"{pointer} index {index} outside 0..3"):
        load(viper("return x[i]", f"x: {pointer}, i: int")).kernel(memory, index)
    with pytest.raises(IndexError):
        load(viper("x[i] = 1\nreturn 0", f"x: {pointer}, i: int")).kernel(memory, index)
    assert list(memory) == [0, 1, 2, 3]


def test_half_an_element_at_the_end_and_a_null_pointer_have_no_index(load):
    kernel = load(viper("return x[i]", "x: ptr32, i: int")).kernel
    with pytest.raises(IndexError):
        kernel(bytes(7), 1)
    for nothing in (None, b"", array("i")):
        with pytest.raises(IndexError):
            kernel(nothing, 0)


@pytest.mark.parametrize(
    ("pointer", "typecode", "value", "stored"),
    [
        ("ptr8", "B", 255, 255),
        ("ptr8", "b", -1, -1),
        ("ptr16", "H", 65535, 65535),
        ("ptr16", "h", -32768, -32768),
        ("ptr32", "i", -HIGH_32 - 1, -HIGH_32 - 1),
        ("ptr32", "I", -1, 2**32 - 1),
    ],
)
def test_store_writes_what_fits(load, pointer, typecode, value, stored):
    memory = array(typecode, [0, 0])
    load(viper("x[1] = v\nreturn 0", f"x: {pointer}, v: int")).kernel(memory, value)
    assert list(memory) == [0, stored]


@pytest.mark.parametrize(("pointer", "value"), [("ptr8", 256), ("ptr8", -129), ("ptr16", 65536), ("ptr16", -32769)])
def test_store_that_would_lose_bits_raises(load, pointer, value):
    with pytest.raises(IntegerRange, match=f"{value} stored through {pointer}"):
        load(viper("x[0] = v\nreturn 0", f"x: {pointer}, v: int")).kernel(bytearray(4), value)


def test_element_is_updated_in_place(load):
    memory = array("i", [1, HIGH_32])
    kernel = load(viper("x[i] += 1\nreturn 0", "x: ptr32, i: int")).kernel
    kernel(memory, 0)
    assert list(memory) == [2, HIGH_32]
    with pytest.raises(IntegerRange):
        kernel(memory, 1)


@pytest.mark.parametrize(
    "memory", [0x40050000, array("l", [1]), array("f", [1]), 1.5], ids=["address", "long", "float", "number"]
)
def test_pointer_needs_memory_that_is_alike_on_every_port(load, memory):
    with pytest.raises(TypeError):
        load(viper("return x[0]", "x: ptr32")).kernel(memory)


@pytest.mark.parametrize("expression", ["a / b", "a ** b"])
def test_operator_that_viper_lacks_is_refused(load, expression):
    with pytest.raises(TypeError, match="viper has no"):
        load(viper(f"return {expression}"))


def test_argument_that_is_no_integer_is_refused(load):
    with pytest.raises(TypeError, match="the argument a gives"):
        load(viper("return a")).kernel(1.5, 0)


def test_imports_of_the_project_are_checked_and_overrides_stand_in(tmp_path):
    (tmp_path / "firmware" / "deep").mkdir(parents=True)
    (tmp_path / "shared").mkdir()
    kernel = "import micropython\n" + viper("return a * b")
    (tmp_path / "shared" / "fixed.py").write_text(kernel)
    (tmp_path / "firmware" / "deep" / "inner.py").write_text("from shared.fixed import kernel\nCOUNT = 3\n")
    (tmp_path / "firmware" / "user.py").write_text(
        dedent(
            """
            import firmware.deep.inner
            import firmware.other
            import shared.fixed as fixed
            import machine, math
            from array import array
            from firmware import other
            from firmware.deep import inner

            def product(a, b):
                return fixed.kernel(a, b)

            same = fixed.kernel is inner.kernel is firmware.deep.inner.kernel
            values = machine, other.NAME, firmware.other.NAME, math.pi, array("i", [1])[0], inner.COUNT
            """
        )
    )

    class Other:
        NAME = "other"

    module = load_checked("firmware/user.py", {"machine": "fake", "firmware.other": Other}, root=tmp_path)
    assert module.same
    assert module.values == ("fake", "other", "other", pytest.approx(3.14159265), 1, 3)
    with pytest.raises(IntegerRange):
        module.product(65536, 65536)
    with pytest.raises(ImportError, match=r"firmware\.absent"):
        load_checked(_written(tmp_path / "b.py", "import firmware.absent\n"), root=tmp_path)


def _written(path, text):
    path.write_text(text)
    return path


def test_kernel_may_call_another_and_hand_on_its_pointers(load):
    module = load(
        """
        @micropython.viper
        def at(x: ptr32, i: int) -> int:
            return x[i]

        @micropython.viper
        def total(x: ptr32, count: int) -> int:
            total = 0
            for i in range(count):
                total += int(at(x, i))
            return total
        """
    )
    assert module.total(array("i", [1, -2, 4]), 3) == 3
    with pytest.raises(IndexError):
        module.total(array("i", [1, -2, 4]), 4)


def test_extremes_tell_how_far_a_kernel_was_driven(load):
    module = load(viper("return (a * b) >> 2"))
    assert extremes(module) == {}
    module.kernel(-5, 8)
    module.kernel(5, 7)
    assert extremes(module) == {"kernel": (-40, 35)}


def test_pointer_casts_another_width_of_the_same_memory():
    memory = array("I", [0x11223344])
    octets = Pointer(Pointer(memory, 32), 8)
    octets[0] = 0x55
    assert [octets[i] for i in range(4)] == [0x55, 0x33, 0x22, 0x11]
    assert memory[0] == 0x11223355
