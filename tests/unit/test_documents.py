"""The documents say what the code says."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\(([^)#:]+)\)")
FILE = re.compile(r"`((?:firmware|host|shared|tests|tools|emulator|puppets)/[\w./-]+\.(?:py|toml|mjs|c|sh))`")


def test_link_document_tables_are_those_of_the_dictionary():
    spec = importlib.util.spec_from_file_location("message_tables", ROOT / "tools" / "message_tables.py")
    message_tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(message_tables)
    text = message_tables.DOCUMENT.read_text(encoding="utf-8")
    assert message_tables.with_tables(text) == text, "run python tools/message_tables.py"


def test_documents_link_to_files_that_exist():
    missing = [
        f"{document.name}: {target}"
        for document in DOCUMENTS
        for target in LINK.findall(document.read_text(encoding="utf-8"))
        if not (document.parent / target).exists()
    ]
    assert not missing


def test_documents_name_files_that_exist():
    missing = [
        f"{document.name}: {name}"
        for document in DOCUMENTS
        for name in FILE.findall(document.read_text(encoding="utf-8"))
        if not (ROOT / name).exists()
    ]
    assert not missing
