"""A fault of MicroPython's compiler for the RP2040 that kernels must stay clear of.

The first two local variables of a viper function live in registers. For an indexed access to 16- or 32-bit words the
compiler (1.26.1) shifts the register that holds the index and does not shift it back, so a variable that lives in a register
is wrong after it has been an index. Parameters come first: they are arrays and counts, and no kernel may use one of the
first ones as an index. The PC's MicroPython has no such fault, so only this test and the RP2040 can tell.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
IN_REGISTERS = 2


def kernels():
    """Return all viper functions of the firmware, by file and name."""
    for path in sorted([*ROOT.glob("firmware/*.py"), *ROOT.glob("shared/*.py")]):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and "micropython.viper" in map(ast.unparse, node.decorator_list):
                yield pytest.param(node, id=f"{path.stem}.{node.name}")


def first_locals(function):
    """Return the first local variables in the compiler's order: parameters, then names as they are first assigned."""
    names = [argument.arg for argument in function.args.args]
    stores = [node for node in ast.walk(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    for node in sorted(stores, key=lambda node: (node.lineno, node.col_offset)):
        if node.id not in names:
            names.append(node.id)
    return names[:IN_REGISTERS]


def shifted_indices(function):
    """Return the names that stand alone as an index of anything but bytes."""
    arguments = function.args.args
    bytes_of = {argument.arg for argument in arguments if argument.annotation and argument.annotation.id == "ptr8"}
    return {
        node.slice.id
        for node in ast.walk(function)
        if isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Name)
        and ast.unparse(node.value) not in bytes_of
    }


@pytest.mark.parametrize("function", list(kernels()))
def test_kernel_indexes_with_no_variable_that_lives_in_a_register(function):
    assert not shifted_indices(function).intersection(first_locals(function))
