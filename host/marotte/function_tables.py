"""Reading the `[function.NAME]` of a puppet file, and what the FUNCTION of a mapping means with them."""

from __future__ import annotations

from itertools import islice
from typing import Any

from marotte import functions
from marotte.expressions import PHASE
from marotte.functions import Function, FunctionError
from marotte.puppet import Curve
from marotte.tomlfile import Document, Table, check_number, found, is_identifier
from shared import formats

FUNCTIONS_MAX = 512
SAMPLES_RANGE = (2, formats.SAMPLES_MAX)


class FunctionReader:
    """Reads the custom functions of one file; after `curves`, `parse` knows them."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._functions: dict[str, Function] = {}
        self._parsed: dict[str | None, Function | FunctionError] = {}

    def curves(self, root: Table) -> dict[str, Curve]:
        """Return the `[function.NAME]`s in the file's order; tables are read first, as expressions may name them."""
        tables = dict(root.tables("function"))
        if len(tables) > FUNCTIONS_MAX:
            root.mistake(f"has {len(tables)} functions, expected at most {FUNCTIONS_MAX}", "function")
            tables = dict(islice(tables.items(), FUNCTIONS_MAX))
        curves = {}
        for name in sorted(tables, key=lambda name: tables[name].has("expr")):
            curves[name] = self.curve(name, tables[name])
            self._functions[name] = curves[name].function
        return {name: curves[name] for name in tables}

    def curve(self, name: str, table: Table) -> Curve:
        if name in functions.PRIMITIVES or name == PHASE:
            table.mistake(f'"{name}" is the name of a primitive; expected another name')
        elif not is_identifier(name):
            table.mistake("expected a name of letters, digits and _, as it stands in expressions")
        expression = table.text("expr", "") if table.has("expr") else None
        samples = self.samples(table) if table.has("table") else ()
        function = Function("curve", (name,)) if table.has("table") else Function("const", (0.0,))
        if isinstance(table.value("expr"), str):
            try:
                function = functions.parse_expression(table.value("expr"), self._functions)
            except FunctionError as error:
                table.mistake(f"found {found(table.value('expr'))}: {error}", "expr")
        if table.has("expr") == table.has("table"):
            what = "both" if table.has("expr") else "neither"
            table.mistake(f'has {what}, expected one of "expr" and "table"')
        table.finish()
        return Curve(name, function, expression, samples)

    def samples(self, table: Table) -> tuple[float, ...]:
        values = table.array("table", "an array of samples in 0..1") or []
        if values and not SAMPLES_RANGE[0] <= len(values) <= SAMPLES_RANGE[1]:
            low, high = SAMPLES_RANGE
            table.mistake(f"found {len(values)} samples, expected {low}..{high}", "table")
        path = (*table.path, "table")
        good = [check_number(self._document, (*path, index), value, 0, 1) for index, value in enumerate(values)]
        return tuple(float(value) for value in values) if all(good) else ()

    def parse(self, text: Any) -> Function | FunctionError:
        """Return what a FUNCTION means, or what is wrong with it; each text is parsed once."""
        key = text if isinstance(text, str) else None
        if key not in self._parsed:
            try:
                self._parsed[key] = functions.parse_function(text, self._functions)
            except FunctionError as error:
                self._parsed[key] = error
        return self._parsed[key]
