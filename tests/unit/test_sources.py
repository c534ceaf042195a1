"""What the sources promise as texts: who imports whom, numbers repeated beside their declaration, and kernels without a test."""

import ast
import re
from pathlib import Path

import pytest

from shared import formats, messages, program

CHECKOUT = Path(__file__).parents[2]
SOURCES = {folder: sorted((CHECKOUT / folder).rglob("*.py")) for folder in ("firmware", "shared", "host")}
OURS = {"firmware", "shared", "marotte", "host", "tests", "tools"}
MAY_IMPORT = {"firmware": {"firmware", "shared"}, "shared": {"shared"}, "host": {"marotte", "shared"}}
FILES = [(folder, path) for folder, paths in SOURCES.items() for path in paths]


def tree_of(path):
    return ast.parse(path.read_text("utf-8"), str(path))


def imports_of(path):
    """Return the top names of all modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names.add(node.module.partition(".")[0])
    return names


@pytest.mark.parametrize(("folder", "path"), FILES, ids=[str(path.relative_to(CHECKOUT)) for _, path in FILES])
def test_imports_go_to_shared_and_never_across(folder, path):
    assert imports_of(path) & OURS <= MAY_IMPORT[folder]


def test_imports_of_machine_are_in_one_file():
    importing = {path.name for _, path in FILES if imports_of(path) & {"machine", "rp2"}}
    assert importing == {"board_rp2040.py"}


def test_shared_imports_only_what_both_interpreters_have():
    both = [path for path in SOURCES["shared"] if path.name != "cpython.py"]
    names = set().union(*map(imports_of, both))
    assert names <= {"array", "struct", "micropython", "shared"}


CONSTANTS = [
    ("functions", "_RSIN", formats.FUNCTION_RSIN),
    ("functions", "_RCOS", formats.FUNCTION_RCOS),
    ("functions", "_NOISE", formats.FUNCTION_NOISE),
    ("functions", "_CONST", formats.FUNCTION_CONST),
    ("functions", "_CURVE", formats.FUNCTION_CURVE),
    ("programs", "_PROGRAM", formats.FUNCTION_PROGRAM),
    ("programs", "_LIMIT", program.LIMIT_Q16),
    ("programs", "_CONST", program.CONST),
    ("programs", "_RSIN", program.RSIN),
    ("programs", "_RCOS", program.RCOS),
    ("programs", "_NOISE", program.NOISE),
    ("programs", "_CURVE", program.CURVE),
    ("programs", "_LIVE", program.LIVE),
    ("programs", "_ADD", program.ADD),
    ("programs", "_SUB", program.SUB),
    ("programs", "_MUL", program.MUL),
    ("programs", "_SCALE", program.SCALE),
    ("programs", "_NEG", program.NEG),
    ("programs", "_ABS", program.ABS),
    ("programs", "_MIN", program.MIN),
    ("programs", "_MAX", program.MAX),
    ("programs", "_CLAMP", program.CLAMP),
    ("blinks", "_RTRIGSIN", formats.FUNCTION_RTRIGSIN),
    ("actions", "_ENTRY_START", formats.ENTRY_START),
    ("exchange", "_NEW", formats.NEW),
    ("motor", "_ONE_Q15", formats.VALUE_ONE),
]


@pytest.mark.parametrize(("module", "name", "expected"), CONSTANTS)
def test_constant_repeated_in_the_firmware_is_the_shared_one(module, name, expected):
    found = [
        ast.literal_eval(node.value.args[0])
        for node in tree_of(CHECKOUT / "firmware" / f"{module}.py").body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name
    ]
    assert found == [expected]


LITERALS = [
    ("weights", "integrate", formats.SNAP_Q28),
    ("compositor", "hold_targets", formats.FAINT_Q28),
    ("compositor", "hold_targets", formats.WEIGHT_ONE),
    ("actions", "_phases", formats.CYCLES - 1),
    ("actions", "_phases", (1 << formats.PHASE_BITS) - 1),
    ("functions", "evaluate", formats.VALUE_ONE),
    ("functions", "evaluate", (1 << formats.PHASE_BITS) - 1),
    ("functions", "evaluate", 1 << (formats.PHASE_BITS - 2)),
    ("actions", "_rebase", formats.CYCLES - 1),
    ("actions", "_risen", formats.FAINT_Q28),
    ("blinks", "_evaluate", formats.FUNCTION_BLINK),
    ("blinks", "_evaluate", formats.VALUE_ONE),
    ("programs", "_evaluate", formats.VALUE_ONE),
    ("motor", "_move", formats.VALUE_ONE // 2),
]


@pytest.mark.parametrize(("module", "function", "expected"), LITERALS)
def test_number_written_out_in_a_kernel_is_the_shared_one(module, function, expected):
    kernel = next(node for node in tree_of(CHECKOUT / "firmware" / f"{module}.py").body if _named(node, function))
    numbers = {
        node.value for node in ast.walk(kernel) if isinstance(node, ast.Constant) and isinstance(node.value, int)
    }
    assert expected in numbers


def test_no_message_id_begins_a_packet_as_a_call_for_the_repl():
    assert 3 not in {message[1] for message in messages.MESSAGES}


def test_every_kernel_is_called_by_a_test_in_checked_integers():
    kernels = {
        f"{path.stem}.{node.name}"
        for folder in ("firmware", "shared")
        for path in SOURCES[folder]
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.FunctionDef) and "micropython.viper" in map(ast.unparse, node.decorator_list)
    }
    tests = "\n".join(path.read_text("utf-8") for path in (CHECKOUT / "tests" / "kernels").glob("test_*.py"))
    assert len(kernels) >= 15
    assert {kernel for kernel in kernels if not re.search(rf"\b[A-Z]+\.{kernel.partition('.')[2]}\(", tests)} == set()


def _named(node, name):
    return isinstance(node, ast.FunctionDef) and node.name == name
