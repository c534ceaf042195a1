"""The checked MCU checks what it claims to check."""

import ast
from pathlib import Path

import pytest

from tests.checked import IntegerRange
from tests.motion import checked_mcu
from tests.motion.checked_mcu import SMALL_INT_FUNCTIONS, CheckedMcu

CHECKOUT = Path(__file__).parents[2]


def functions_of(path):
    """Return the names of a file's functions, with their classes'."""
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.ClassDef):
            yield from (f"{node.name}.{method.name}" for method in node.body if isinstance(method, ast.FunctionDef))


def test_each_function_that_is_checked_exists_and_is_listed_once():
    paths = [path for folder in ("firmware", "shared") for path in (CHECKOUT / folder).glob("*.py")]
    known = {name for path in paths for name in functions_of(path)}
    assert [name for name in SMALL_INT_FUNCTIONS if name not in known] == []
    assert len(set(SMALL_INT_FUNCTIONS)) == len(SMALL_INT_FUNCTIONS)


def test_integer_that_would_allocate_is_told_with_its_place(monkeypatch):
    monkeypatch.setattr(checked_mcu, "SMALL_INT_FUNCTIONS", (*SMALL_INT_FUNCTIONS, "Motor._set_rates"))
    with pytest.raises(IntegerRange, match=r"Motor\._set_rates"), CheckedMcu() as mcu:
        mcu.run_for(1000)


def test_checked_mcu_can_be_reset():
    with CheckedMcu() as mcu:
        mcu.run_for(100_000)
        mcu.reset()
        mcu.run_for(100_000)
        assert mcu.report()["resets"] == 1
