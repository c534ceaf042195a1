"""Reading a TOML file so that every mistake in it is found and reported, not only the first.

A `Document` collects `Mistake`s; a `Table` hands out the values of one TOML table, each checked on the way, and at the end
reports the keys that nobody asked for. Every method returns something usable whatever the file holds (its default where
the value is wrong), so that the reader goes on and finds the next mistake.

Numbers with a point are read as `Decimal`, so that the text's own value is known exactly.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from marotte.errors import MarotteError
from marotte.positions import KeyPath, line_numbers
from marotte.textfile import UnreadableError, read_text

T = TypeVar("T")

_TOML_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NAME = re.compile(r"[\w-]+")
_FOUND_MAX = 60
_FOUND_DEPTH_MAX = 3
MISTAKES_MAX = 100
"""Mistakes of one file that are told; with more, something else is wrong with it."""

_DOTS_MAX = 600
_NEAR_MAX = 200
"""Longest list of names in which a similar one is looked for, and longest such name."""

_DECIMALS = Context(prec=60, Emin=-400, Emax=400, traps=[])
"""Numbers with a point keep 60 digits and become 0 below 10^-400: as a fraction, 1e-999999999 would fill the memory."""


@dataclass(frozen=True)
class Mistake:
    """One mistake in one file: where it is, what was found and what was expected."""

    file: str
    line: int | None
    """From 1; None where it is not known."""
    key: str
    """The key path, like `action.NOD.map[2][1]`; indices count from 0."""
    text: str

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        return f"{place} {self.key}: {self.text}" if self.key else f"{place}: {self.text}"


class FileMistakes(MarotteError):
    """One or more files have mistakes; `mistakes` holds them all, in the files' order."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        super().__init__("\n".join(str(mistake) for mistake in mistakes))
        self.mistakes = tuple(mistakes)


class TooManyMistakes(Exception):
    """A file has so many mistakes that it is not looked at any further."""


def key_text(path: KeyPath) -> str:
    """Return a key path as text: `("cue", 3, "at")` is `cue[3].at`."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            text += ("." if text else "") + _short(key if _NAME.fullmatch(key) else repr(key))
    return text


def found(value: object, depth: int = 0) -> str:
    """Return a value as a mistake quotes it: TOML's spelling, not too long. `depth` is how many arrays it is in."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, str):
        text = '"' + value[:_FOUND_MAX].encode("unicode_escape").decode("ascii") + '"'
    elif isinstance(value, list) and depth == _FOUND_DEPTH_MAX:
        text = "[...]"
    elif isinstance(value, list):
        text = "[" + ", ".join(found(item, depth + 1) for item in value[:8]) + (", ...]" if len(value) > 8 else "]")
    elif isinstance(value, int) and abs(value) >= 10**20:
        text = "an enormous number"
    else:
        text = str(value)
    return _short(text)


def _short(text: str) -> str:
    return text if len(text) <= _FOUND_MAX else text[: _FOUND_MAX - 4] + " ..."


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean "X"?` if a known name is near, else an empty text."""
    by_case = {candidate.lower(): candidate for candidate in islice(known, _NEAR_MAX) if len(candidate) <= _NEAR_MAX}
    if len(name) > _NEAR_MAX:
        return ""
    near = difflib.get_close_matches(name.lower(), by_case, n=1)
    return f'; did you mean "{by_case[near[0]]}"?' if near else ""


def is_number(value: object) -> bool:
    """Return whether a TOML value is a finite number."""
    if isinstance(value, bool):
        return False
    return isinstance(value, int) or (isinstance(value, Decimal) and value.is_finite())


class Document:
    """A TOML file that is being read: its values, its lines and its mistakes so far."""

    def __init__(self, path: str | Path) -> None:
        """Read and parse a file; what stands in the way (no such file, no text, no TOML) becomes a mistake."""
        self.path = Path(path)
        self.mistakes: list[Mistake] = []
        self._lines: dict[KeyPath, int] = {}
        self._values: dict[str, Any] = {}
        text = self._text()
        if text is not None:
            self._parse(text)

    def root(self) -> Table:
        """Return the file's outermost table; an empty one if the file could not be parsed."""
        return Table(self, (), self._values)

    @property
    def is_parsed(self) -> bool:
        """Whether there is no mistake yet."""
        return not self.mistakes

    def keys(self) -> frozenset[str]:
        """Return the keys of the outermost table."""
        return frozenset(self._values)

    def mistake(self, path: KeyPath, text: str) -> None:
        """Note a mistake at a key path; one that is not in the file is placed at the table that it belongs to.

        Raises TooManyMistakes with the last one that is told; `read_until_full` takes care of that.
        """
        prefixes = (path[:length] for length in range(len(path), 0, -1))
        line = next((self._lines[prefix] for prefix in prefixes if prefix in self._lines), None)
        self.mistakes.append(Mistake(str(self.path), line, key_text(path), text))
        if len(self.mistakes) >= MISTAKES_MAX:
            raise TooManyMistakes

    def in_order(self) -> list[Mistake]:
        """Return the mistakes in the order of their lines, those without one last."""
        mistakes = sorted(self.mistakes, key=lambda mistake: (mistake.line is None, mistake.line or 0))
        if len(mistakes) >= MISTAKES_MAX:
            mistakes.append(Mistake(str(self.path), None, "", "has more mistakes, which were not looked for"))
        return mistakes

    def read_until_full(self, read: Callable[[], T], rest: T) -> T:
        """Return what `read` makes of the document; `rest` if it cannot be parsed or has too many mistakes."""
        if not self.is_parsed:
            return rest
        try:
            return read()
        except TooManyMistakes:
            return rest

    def _text(self) -> str | None:
        try:
            return read_text(self.path)
        except UnreadableError as error:
            self.mistake((), str(error))
        return None

    def _parse(self, text: str) -> None:
        for number, line in enumerate(text.split("\n"), start=1):
            if line.count(".") > _DOTS_MAX and not line.lstrip().startswith("#"):
                # `tomllib` takes a time that grows with the square of the parts of a dotted key.
                what = f"has {line.count('.')} points, expected at most {_DOTS_MAX} in a line"
                self.mistakes.append(Mistake(str(self.path), number, "", what))
                return
        try:
            self._values = tomllib.loads(text, parse_float=_decimal)
        except tomllib.TOMLDecodeError as error:
            self._syntax_mistake(str(error), text)
        except ValueError:
            self.mistake((), "holds a number that is too long to be read")
        except RecursionError:
            self.mistake((), "is nested too deeply")
        else:
            self._lines = line_numbers(text)

    def _syntax_mistake(self, message: str, text: str) -> None:
        place = _TOML_PLACE.search(message)
        line = None
        what = message
        if place:
            line = int(place[1]) if place[1] else text.count("\n", 0, len(text.rstrip())) + 1
            what = message[: place.start()] + (f" in column {place[2]}" if place[2] else " at the end of the file")
        self.mistakes.append(Mistake(str(self.path), line, "", f"not valid TOML: {what[:1].lower()}{what[1:]}"))


def _decimal(text: str) -> Decimal:
    rounded = _DECIMALS.create_decimal(text)
    if rounded.is_finite():
        return rounded
    try:
        return Decimal(text)  # which no key takes: it is only told
    except ArithmeticError:
        return Decimal("inf")


class Table:
    """One table of a document, read key by key."""

    def __init__(self, document: Document, path: KeyPath, values: Mapping[str, Any]) -> None:
        self.document = document
        self.path = path
        self._values = values
        self._asked: dict[str, None] = {}

    def has(self, key: str) -> bool:
        """Return whether the key is there."""
        self._asked[key] = None
        return key in self._values

    def names(self) -> list[str]:
        """Return the keys, for tables whose keys are names of the user's choice; they count as asked for."""
        self._asked.update(dict.fromkeys(self._values))
        return list(self._values)

    def value(self, key: str, default: Any = None) -> Any:
        """Return a value as it is in the file, unchecked."""
        return self._values[key] if self.has(key) else default

    def require(self, key: str, expected: str) -> bool:
        """Return whether the key is there; if not, that is a mistake of the table."""
        if self.has(key):
            return True
        self.mistake(f'has no "{key}"; expected {expected}')
        return False

    def mistake(self, text: str, *keys: str | int) -> None:
        """Note a mistake of the table itself, or of what `keys` lead to in it."""
        self.document.mistake((*self.path, *keys), text)

    def number(self, key: str, low: float, high: float, default: float) -> float:
        """Return a number in `low`..`high`."""
        return float(self._values[key]) if self.has(key) and self.is_number_in(key, low, high) else default

    def is_number_in(self, key: str, low: float, high: float) -> bool:
        """Return whether the value of a key that is there is a number in `low`..`high`."""
        return check_number(self.document, (*self.path, key), self._values[key], low, high)

    def integer(self, key: str, low: int, high: int, default: int) -> int:
        """Return a whole number in `low`..`high`, written without a point."""
        if not self.has(key):
            return default
        value = self._values[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.mistake(f"found {found(value)}, expected a whole number in {low}..{high}", key)
            return default
        return value

    def boolean(self, key: str, default: T) -> bool | T:
        """Return `true` or `false`."""
        if not self.has(key):
            return default
        value = self._values[key]
        if not isinstance(value, bool):
            self.mistake(f"found {found(value)}, expected true or false", key)
            return default
        return value

    def text(self, key: str, default: str) -> str:
        """Return a text."""
        if not self.has(key):
            return default
        value = self._values[key]
        if not isinstance(value, str):
            self.mistake(f"found {found(value)}, expected a text", key)
            return default
        return value

    def choice(self, key: str, options: Sequence[str], default: str) -> str:
        """Return one of a few words."""
        if not self.has(key):
            return default
        value = self._values[key]
        if not isinstance(value, str) or value not in options:
            words = " or ".join(f'"{option}"' for option in options)
            self.mistake(f"found {found(value)}, expected {words}", key)
            return default
        return value

    def numbers(self, key: str, count: int, low: float, high: float, what: str) -> list[float] | None:
        """Return an array of exactly `count` numbers, each in `low`..`high`, described as `what`; None if it is not that."""
        values = self.array(key, what)
        if values is None:
            return None
        if len(values) != count:
            self.mistake(f"found {len(values)} values, expected {count}: {what}", key)
            return None
        path = (*self.path, key)
        good = [check_number(self.document, (*path, index), value, low, high) for index, value in enumerate(values)]
        return [float(value) for value in values] if all(good) else None

    def array(self, key: str, what: str) -> list[Any] | None:
        """Return an array's values, unchecked, described as `what`; None if there is no array."""
        if not self.has(key):
            return None
        value = self._values[key]
        if not isinstance(value, list):
            self.mistake(f"found {found(value)}, expected {what}", key)
            return None
        return value

    def table(self, key: str) -> Table:
        """Return a table within; an empty one where there is none."""
        value = self.value(key, {})
        if not isinstance(value, Mapping):
            self.mistake(f"found {found(value)}, expected a table", key)
            value = {}
        return Table(self.document, (*self.path, key), value)

    def tables(self, key: str) -> Iterator[tuple[str, Table]]:
        """Yield name and table of each `[key.NAME]`, in the file's order."""
        outer = self.table(key)
        for name in outer.names():
            if _NAME.fullmatch(name):
                yield name, outer.table(name)
            else:
                outer.mistake("expected a name of letters, digits, _ and -", name)

    def list_of_tables(self, key: str) -> list[Table]:
        """Return the tables of all `[[key]]`, in the file's order."""
        values = self.array(key, f"tables, each headed [[{key}]]") or []
        tables = []
        for index, value in enumerate(values):
            if isinstance(value, Mapping):
                tables.append(Table(self.document, (*self.path, key, index), value))
            else:
                self.mistake(f"found {found(value)}, expected a table headed [[{key}]]", key, index)
        return tables

    def finish(self) -> None:
        """Report the keys that nobody asked for."""
        for key in self._values:
            if key not in self._asked:
                hint = did_you_mean(key, self._asked) or f"; expected {_words(self._asked)}"
                self.mistake(f"unknown key{hint}", key)


def check_number(document: Document, path: KeyPath, value: object, low: float, high: float) -> bool:
    """Return whether a value is a number in `low`..`high`; if not, note the mistake."""
    # A limit such as 0.05 means the decimal, not the binary fraction next to it.
    if is_number(value) and Decimal(str(low)) <= value <= Decimal(str(high)):  # type: ignore[operator]
        return True
    document.mistake(path, f"found {found(value)}, expected a number in {low:g}..{high:g}")
    return False


def is_identifier(name: str) -> bool:
    """Return whether a name may stand in an expression."""
    return _IDENTIFIER.fullmatch(name) is not None


def _words(keys: Iterable[str]) -> str:
    return ", ".join(f'"{key}"' for key in keys) or "nothing here"
