"""The message dictionary as the tables of `docs/link.md`: `python tools/message_tables.py` writes them anew.

The tables stand between two marks; a test holds that they say what `shared/messages.py` says.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from shared import codec, messages  # noqa: E402

DOCUMENT = ROOT / "docs" / "link.md"
BEGIN = "<!-- tables of tools/message_tables.py -->"
END = "<!-- end of tables -->"
TYPES = {"B": "u8", "H": "u16", "I": "u32", "i": "i32"}


def tables():
    """Return the tables as Markdown."""
    checksum = codec.crc32(messages.canonical_text().encode())
    lines = [f"Protocol {messages.PROTOCOL}, dictionary {checksum:08x}.", ""]
    for title, to_mcu in (("To the MCU, acknowledged", True), ("From the MCU", False)):
        lines += [f"| {title} | id | fields | repeated |", "| --- | --- | --- | --- |"]
        for name, message_id, fields, items in messages.MESSAGES:
            if (message_id < 128) == to_mcu:
                lines.append(f"| `{name}` | {message_id:#04x} | {_pairs(fields)} | {_pairs(items)} |")
        lines.append("")
    lines += ["| status | meaning |", "| --- | --- |"]
    lines += [f"| {status} | {text} |" for status, text in enumerate(messages.STATUS_TEXT)]
    return "\n".join(lines)


def with_tables(text):
    """Return a document's text with the part between the marks replaced. Raises ValueError if a mark is missing."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{tables()}\n{END}{after}"


def _pairs(pairs):
    return ", ".join(f"`{name}` {TYPES[kind]}" for name, kind in pairs)


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
