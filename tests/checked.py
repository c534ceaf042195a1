"""Runs firmware modules under CPython with every integer checked, to prove that kernels stay in 32 bits.

On hardware viper's arithmetic is modulo 2^32 and its pointers know no bounds; on the 64-bit port it
is 64 bits wide. A kernel that never leaves 32 bits and never indexes outside its arrays does the same
on both, and the same as here, where either mistake raises. So `load_checked` rewrites a module's
source before it runs it:

- In functions under `@micropython.viper` the result of every operator, every `int(...)`, every
  argument and result declared `int` must fit a signed integer of `limit_bits`; shift counts lie in
  0..31; arguments declared `ptr8`, `ptr16` or `ptr32` become bounds-checked views.
- In functions named in `bytecode`, per frame code that must not allocate, every operator's result
  that is an int must be a small int of a 32-bit port (-2^30 .. 2^30 - 1).
- In viper functions named in `patterns` a bit operation may give any 32 bits; a result of 2^31 or
  more goes on as the negative number of the same bits, as on 32-bit hardware.

Everything else runs as it stands. Modules of `firmware` and `shared` that the source imports are
loaded in the same way, once for each call of `load_checked`.
"""

import ast
import builtins
import types
from pathlib import Path

from tests.checked_values import CheckedPlace, IntegerRange, Pointer

__all__ = ["IntegerRange", "Pointer", "extremes", "load_checked"]

_CHECKOUT = Path(__file__).resolve().parent.parent
_PACKAGES = ("firmware", "shared")
_SMALL_INT_BITS = 31
_POINTER_BITS = {"ptr8": 8, "ptr16": 16, "ptr32": 32}
_INTEGERS = ("int", "uint")
_BIT_OPERATORS = (ast.LShift, ast.RShift, ast.BitAnd, ast.BitOr, ast.BitXor, ast.Invert)


def load_checked(path, overrides=None, limit_bits=32, bytecode=(), patterns=(), root=_CHECKOUT):
    """Load a module of the firmware with checked integers and pointers.

    Args:
        path: of the source file, absolute or from `root`.
        overrides: modules to import instead of real ones, by dotted name: `{"machine": fake}`.
        limit_bits: what an integer of a viper function must fit, sign included.
        bytecode: names of plain functions (`"step"`, `"Link.poll"`) whose integers must stay small.
        patterns: names of viper functions in which bit operations may give any 32 bits.
            Both kinds of names hold for every module that is loaded.
        root: the folder that has the packages `firmware` and `shared`; the checkout.

    Returns:
        The module. Its functions run under CPython; those checked raise `IntegerRange`, `IndexError`
        for an index outside its array, and `TypeError` for what viper cannot take.
    """
    loader = _Loader(root, overrides or {}, limit_bits, frozenset(bytecode), frozenset(patterns))
    return loader.load(path)


def extremes(module):
    """Return {function: (least, greatest)}, the range that checked integers of a module have reached."""
    reached = {}
    for place in module.__dict__["__places__"]:
        if place.reached:
            least, greatest = reached.get(place.function, (place.least, place.greatest))
            reached[place.function] = min(least, place.least), max(greatest, place.greatest)
    return reached


class _Loader:
    """Loads one module and those that it imports, each once."""

    def __init__(self, root, overrides, limit_bits, bytecode, patterns):
        self._root = root
        self._options = limit_bits, bytecode, patterns
        self._files = {}
        micropython = types.SimpleNamespace(
            viper=_unchanged, native=_unchanged, const=_unchanged, heap_lock=_nothing, heap_unlock=_nothing
        )
        self._modules = {"micropython": micropython, **overrides}

    def load(self, path):
        path = self._root / path
        if path in self._files:
            return self._files[path]
        module = self._files[path] = types.ModuleType(path.stem)
        instrumenter = _Instrumenter(path, *self._options)
        tree = instrumenter.visit(ast.parse(path.read_text("utf-8"), str(path)))
        pointers = {name: lambda memory, bits=bits: Pointer(memory, bits) for name, bits in _POINTER_BITS.items()}
        machinery = {"__builtins__": vars(builtins) | {"__import__": self._import}, "__places__": instrumenter.places}
        module.__dict__.update(pointers | machinery | instrumenter.helpers)
        exec(compile(ast.fix_missing_locations(tree), str(path), "exec"), module.__dict__)
        return module

    def _import(self, name, variables=None, local=None, members=(), level=0):
        """Stand in for `__import__` in the modules loaded."""
        head = name.partition(".")[0]
        if head not in _PACKAGES and name not in self._modules:
            return builtins.__import__(name, variables, local, members, level)
        module = self._module(name)
        for member in members or ():
            if not hasattr(module, member):
                self._module(f"{name}.{member}")
        return module if members else self._module(head)

    def _module(self, name):
        """Return a module or package by its dotted name; its package has it as an attribute from now on."""
        package, _, member = name.rpartition(".")
        if name not in self._modules:
            path = self._root / name.replace(".", "/")
            source = path.with_suffix(".py")
            if not source.exists() and not path.is_dir():
                raise ImportError(f"no module named {name!r}")
            self._modules[name] = self.load(source) if source.exists() else types.SimpleNamespace()
        if package:
            setattr(self._module(package), member, self._modules[name])
        return self._modules[name]


class _Instrumenter(ast.NodeTransformer):
    """Rewrites the checked functions of one module; the rest stays as it is.

    Attributes:
        helpers: names that the rewritten source needs.
        places: those whose integers are checked.
    """

    def __init__(self, path, limit_bits, bytecode, patterns):
        self.helpers = {}
        self.places = []
        self._path = path
        self._limit_bits = limit_bits
        self._bytecode = bytecode
        self._patterns = patterns
        self._scope = []
        self._kind = None
        self._returns_int = False

    def visit_ClassDef(self, node):
        self._scope.append(node.name)
        node = self.generic_visit(node)
        self._scope.pop()
        return node

    def visit_FunctionDef(self, node):
        outer = self._kind, self._returns_int
        self._scope.append(node.name)
        if any(ast.unparse(decorator) == "micropython.viper" for decorator in node.decorator_list):
            self._kind = "viper"
        elif self._function in self._bytecode:
            self._kind = "bytecode"
        else:
            self._kind = None
        self._returns_int = self._kind == "viper" and _name(node.returns) in _INTEGERS
        entry = self._checked_arguments(node) if self._kind == "viper" else []
        node.body = entry + [new for old in node.body for new in _statements(self.visit(old))]
        self._scope.pop()
        self._kind, self._returns_int = outer
        return node

    def visit_Return(self, node):
        shown = ast.unparse(node.value) if node.value else "nothing"
        node = self.generic_visit(node)
        if self._returns_int:
            node.value = self._check(node.value, f"the result {shown}")
        return node

    def visit_Call(self, node):
        shown = ast.unparse(node)
        node = self.generic_visit(node)
        if self._kind == "viper" and _name(node.func) in _INTEGERS:
            return self._check(node.args[0], shown, folds=_name(node.func) == "uint")
        return node

    def visit_BinOp(self, node):
        return self._operation(node)

    def visit_UnaryOp(self, node):
        if isinstance(node.op, ast.Not):
            return self.generic_visit(node)
        return self._operation(node)

    def visit_AugAssign(self, node):
        """Rewrite `place += value` to `place = place + value`; the place's parts must be free of calls."""
        if self._kind is None:
            return node
        if any(isinstance(part, ast.Call) for part in ast.walk(node.target)):
            raise TypeError(f"{self._path.name}:{node.lineno}: a call in the target of {ast.unparse(node)}")
        place = ast.parse(ast.unparse(node.target), mode="eval").body
        value = ast.copy_location(ast.BinOp(place, node.op, node.value), node)
        for part in ast.walk(place):
            ast.copy_location(part, node)
        return ast.copy_location(ast.Assign([self.visit(node.target)], self.visit(value)), node)

    @property
    def _function(self):
        return ".".join(self._scope)

    def _checked_arguments(self, node):
        """Take the declarations off the arguments and return the statements that check them."""
        node.returns = None
        statements = []
        for argument in node.args.args:
            declared, argument.annotation = _name(argument.annotation), None
            value = ast.copy_location(ast.Name(argument.arg, ast.Load()), argument)
            if declared in _INTEGERS:
                value = self._check(value, f"the argument {argument.arg}")
            elif declared in _POINTER_BITS:
                value = ast.copy_location(ast.Call(ast.Name(declared, ast.Load()), [value], []), argument)
            else:
                continue
            place = ast.Name(argument.arg, ast.Store())
            statements.append(ast.copy_location(ast.Assign([place], value), argument))
        return statements

    def _operation(self, node):
        if self._kind is None:
            return self.generic_visit(node)
        shown = ast.unparse(node)
        if self._kind == "viper" and isinstance(node.op, (ast.Div, ast.Pow, ast.MatMult)):
            raise TypeError(f"{self._path.name}:{node.lineno}: viper has no {shown}")
        node = self.generic_visit(node)
        if self._kind == "viper" and isinstance(node.op, (ast.LShift, ast.RShift)):
            node.right = self._helper("check_count", node.right, shown)
        return self._check(node, shown, folds=isinstance(node.op, _BIT_OPERATORS))

    def _check(self, node, shown, folds=False):
        """Return the node whose value is checked, called `shown` in errors."""
        return self._helper("check" if self._kind == "viper" else "check_if_int", node, shown, folds)

    def _helper(self, method, node, shown, folds=False):
        """Return the call of a new place's method with the node as its argument."""
        where = f"{self._path.name}:{node.lineno} in {self._function}: {shown}"
        bits = self._limit_bits if self._kind == "viper" else _SMALL_INT_BITS
        place = CheckedPlace(where, self._function, bits, folds and self._function in self._patterns)
        self.places.append(place)
        name = f"__check_{len(self.places)}__"
        self.helpers[name] = getattr(place, method)
        return ast.copy_location(ast.Call(ast.Name(name, ast.Load()), [node], []), node)


def _nothing():
    """Stand in for what has no meaning here: CPython's heap cannot be locked."""


def _unchanged(given):
    return given


def _name(node):
    """Return the text of a name's node, or None for anything else; declarations may be strings."""
    if isinstance(node, ast.Constant):
        return node.value
    return node.id if isinstance(node, ast.Name) else None


def _statements(visited):
    return visited if isinstance(visited, list) else [visited]
