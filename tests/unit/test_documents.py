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


ROW_TEST = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)`")


def fault_rows():
    """The rows of the tables of `docs/faults.md`, as lists of cells."""
    lines = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] not in ("fault", "---")]


def test_each_fault_has_a_test_that_exists():
    missing = []
    for fault, *_, test in fault_rows():
        named = ROW_TEST.fullmatch(test)
        text = (ROOT / named[1]).read_text(encoding="utf-8") if named and (ROOT / named[1]).exists() else ""
        if not named or not re.search(rf"^def {named[2]}\(", text, re.MULTILINE):
            missing.append(f"{fault}: {test}")
    assert not missing


def test_each_fault_says_what_host_or_puppet_do():
    for fault, host, puppet, *_ in fault_rows():
        assert host or puppet, fault
