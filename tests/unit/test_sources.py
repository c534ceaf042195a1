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
    ("rings", "_NEW", formats.NEW),
    ("rings", "_DOFS", formats.DOFS_MAX),
    ("rings", "_ZERO_Q16", 1 << 20),  # bands.ZERO_Q16
    ("trajectory", "_DOFS", formats.DOFS_MAX),
    ("trajectory", "_ONE", formats.POSITION_ONE),
    ("character", "_TERMS", len(messages.find(messages.CHARACTER)[2]) - 1),
    ("calibration", "_STILL", formats.POSITION_ONE // 2),
    ("limiter", "_STILL", formats.POSITION_ONE // 2),
    ("feedback", "_ONE", formats.POSITION_ONE),
    ("guards", "_HALF", formats.POSITION_ONE // 2),
    ("driver_bridge", "_STOP_Q24", formats.POSITION_ONE // 2),
    *((module, "_RCOS", formats.FUNCTION_RCOS) for module in ("foresight", "foresight_thumb")),
    *((module, "_NOISE", formats.FUNCTION_NOISE) for module in ("foresight", "foresight_thumb")),
    ("foresight", "_CONST", formats.FUNCTION_CONST),
    *((module, "_LIVE", formats.FUNCTION_LIVE) for module in ("foresight", "foresight_thumb")),
    *((module, "_CURVE", formats.FUNCTION_CURVE) for module in ("foresight", "foresight_thumb")),
    *((module, "_PROGRAM", formats.FUNCTION_PROGRAM) for module in ("foresight", "foresight_thumb", "budget")),
    *((module, "_DOFS", formats.DOFS_MAX) for module in ("bands", "bands_thumb", "signal_processing")),
    *((module, "_ZERO", 1 << 20) for module in ("bands", "bands_thumb")),  # bands.ZERO_Q16
    *((module, "_DELTA_ZERO", 1 << 16) for module in ("bands", "bands_thumb")),
    ("signal_processing", "_ZERO", 1 << 28),  # its ZERO_Q20
    ("outlook", "_ONE_Q28", formats.WEIGHT_ONE),
    ("kalman", "_LIVES", formats.LIVES_MAX),
    ("kalman", "_ONE", formats.WEIGHT_ONE),
    ("motor", "_DOFS", formats.DOFS_MAX),
    ("motor", "_STILL_Q24", formats.POSITION_ONE // 2),
    ("motor", "_CALM_PER_S", 1000 // formats.STAND_MS),
]


ZERO_Q24 = 1 << formats.POSITION_BITS + 4
"""What the motor layer adds to signed words that it stores."""


@pytest.mark.parametrize("module", ["trajectory", "character", "limiter", "feedback", "guards"])
def test_zero_of_signed_words_is_the_same_everywhere(module):
    test_constant_repeated_in_the_firmware_is_the_shared_one(module, "_ZERO", ZERO_Q24)


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
    ("weights", "foresee", formats.SNAP_Q28),
    ("weights", "sketch", formats.ALPHA_ONE),
    ("outlook", "_advance_phases", formats.CYCLES - 1),
    ("outlook", "_advance_phases", (1 << formats.PHASE_BITS) - 1),
    ("outlook", "_sketch_phases", formats.CYCLES - 1),
    ("outlook", "_sketch_phases", (1 << formats.PHASE_BITS) - 1),
    ("foresight", "_evaluate", formats.VALUE_ONE),
    ("foresight", "_evaluate", (1 << formats.PHASE_BITS) - 1),
    ("foresight", "_divide", formats.FAINT_Q28),
    ("foresight_thumb", "evaluate", formats.VALUE_ONE),
    ("bands", "bend", formats.VALUE_ONE),
    ("signal_processing", "_finish", formats.VALUE_ONE),
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
    ("calibration", "tap", formats.VALUE_ONE),
    ("calibration", "calibrate", formats.DOFS_MAX),
    ("calibration", "tap", formats.DOFS_MAX),
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
    """By its name, or by what calls it in its file, in a test that has loaded that file."""
    tests = [path.read_text("utf-8") for path in (CHECKOUT / "tests" / "kernels").glob("test_*.py")]
    found = 0
    missing = []
    for path in (*SOURCES["firmware"], *SOURCES["shared"]):
        if path.name == "board_rp2040.py" or path.stem.endswith("_thumb"):
            continue  # these write registers, or call the chip's own instructions: the emulated chip shows what they do
        functions = [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.FunctionDef)]
        loading = "\n".join(test for test in tests if f'"{path.parent.name}/{path.name}"' in test)
        for kernel in (node for node in functions if "micropython.viper" in map(ast.unparse, node.decorator_list)):
            found += 1
            callers = [node.name for node in functions if kernel.name in _called(node)]
            if not any(re.search(rf"\w\.{name}\(", loading) for name in (kernel.name, *callers)):
                missing.append(f"{path.stem}.{kernel.name}")
    assert found >= 40
    assert missing == []


def _called(node):
    """Return the names of the functions that a function calls."""
    return {
        inner.func.id for inner in ast.walk(node) if isinstance(inner, ast.Call) and isinstance(inner.func, ast.Name)
    }


def _named(node, name):
    return isinstance(node, ast.FunctionDef) and node.name == name
