"""Where in a TOML file each key and each array element stands, which `tomllib` does not tell.

`line_numbers` reads text that `tomllib` has accepted already, so it skips over values instead of checking them. Where it meets
something that it does not understand it stops, and what comes later has no line: a missing line is better than a wrong one.

Source: TOML 1.0.0, https://toml.io/en/v1.0.0.
"""

from __future__ import annotations

import contextlib
import re
from typing import TypeAlias

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and array indices (from 0) that lead from the file's root to a value."""

_BLANK = re.compile(r"[ \t]*")
_GAP = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BASIC_STRING = re.compile(r'"((?:[^"\\\n]|\\.)*)"')
_LITERAL_STRING = re.compile(r"'([^'\n]*)'")
_LONG_STRING = re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}(?!")' + r"|'''.*?'{3,5}(?!')", re.DOTALL)
_SCALAR = re.compile(r"[^\s,\]}#][^,\]}#\n]*")


class _Lost(Exception):
    """The text is not what the scanner expected."""


def line_numbers(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every table header, key and array element of a valid TOML text, by its path.

    A table that several headers name has the line of the first; a table that only dotted keys imply has none.
    """
    scanner = _Scanner(text.replace("\r\n", "\n"))
    with contextlib.suppress(_Lost, RecursionError):
        scanner.document()
    return scanner.found


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.found: dict[KeyPath, int] = {}
        self._line = 1
        self._counted_to = 0
        self._tables: dict[KeyPath, int] = {}  # how many elements each array of tables has so far

    def document(self) -> None:
        """Scan the whole text."""
        table: KeyPath = ()
        while self._skip(_GAP) < len(self.text):
            if self.text.startswith("[", self.at):
                table = self._header()
            else:
                self._key_value(table)

    def _header(self) -> KeyPath:
        line = self._line_here()
        is_array = self.text.startswith("[[", self.at)
        self.at += 2 if is_array else 1
        keys = self._keys()
        self._expect("]]" if is_array else "]")
        path: KeyPath = ()
        for place, key in enumerate(keys):
            path += (key,)
            if is_array and place == len(keys) - 1:
                self._tables[path] = self._tables.get(path, 0) + 1
            if path in self._tables:
                path += (self._tables[path] - 1,)
        self.found.setdefault(path, line)
        return path

    def _key_value(self, table: KeyPath) -> None:
        line = self._line_here()
        path = table + self._keys()
        self._expect("=")
        self.found.setdefault(path, line)
        self._skip(_BLANK)
        self._value(path)

    def _keys(self) -> KeyPath:
        keys: list[str | int] = []
        while True:
            self._skip(_BLANK)
            keys.append(self._key())
            self._skip(_BLANK)
            if not self.text.startswith(".", self.at):
                return tuple(keys)
            self.at += 1

    def _key(self) -> str:
        for pattern in (_BASIC_STRING, _LITERAL_STRING):
            match = pattern.match(self.text, self.at)
            if match:
                if "\\" in match[0] and pattern is _BASIC_STRING:
                    raise _Lost  # an escaped key: rather no line than one under another name
                self.at = match.end()
                return match[1]
        match = self._match(_BARE_KEY)
        return match[0]

    def _value(self, path: KeyPath) -> None:
        here = self.text[self.at : self.at + 3]
        if here in ('"""', "'''"):
            self._match(_LONG_STRING)
        elif here.startswith('"'):
            self._match(_BASIC_STRING)
        elif here.startswith("'"):
            self._match(_LITERAL_STRING)
        elif here.startswith("["):
            self._array(path)
        elif here.startswith("{"):
            self._inline_table(path)
        else:
            self._match(_SCALAR)

    def _array(self, path: KeyPath) -> None:
        self.at += 1
        index = 0
        while True:
            self._skip(_GAP)
            if self._took("]"):
                return
            self.found.setdefault((*path, index), self._line_here())
            self._value((*path, index))
            index += 1
            self._skip(_GAP)
            if not self._took(","):
                self._expect("]")
                return

    def _inline_table(self, path: KeyPath) -> None:
        self.at += 1
        while True:
            self._skip(_GAP)
            if self._took("}"):
                return
            self._key_value(path)
            self._skip(_GAP)
            if not self._took(","):
                self._expect("}")
                return

    def _line_here(self) -> int:
        self._line += self.text.count("\n", self._counted_to, self.at)
        self._counted_to = self.at
        return self._line

    def _skip(self, pattern: re.Pattern[str]) -> int:
        match = pattern.match(self.text, self.at)
        self.at = match.end() if match else self.at
        return self.at

    def _match(self, pattern: re.Pattern[str]) -> re.Match[str]:
        match = pattern.match(self.text, self.at)
        if not match:
            raise _Lost
        self.at = match.end()
        return match

    def _took(self, token: str) -> bool:
        if not self.text.startswith(token, self.at):
            return False
        self.at += len(token)
        return True

    def _expect(self, token: str) -> None:
        self._skip(_BLANK)
        if not self._took(token):
            raise _Lost
