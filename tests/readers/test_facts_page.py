"""docs/reference/facts.md says of every fact what the code does with it, and no fact is left unused in silence."""

import ast
import re
from dataclasses import fields
from pathlib import Path

import levkas
from levkas.readers.compared_facts import ALL, FACTS, LIT
from levkas.readers.envi import EnviFile
from levkas.readers.facts import Facts

PAGE = Path(__file__).resolve().parents[2] / "docs/reference/facts.md"
HOUSE = Path(levkas.__file__).parent
READING = ("reading alone", "ignored")
"""What a field is used for of which nobody but a reader knows."""
OF_AN_ENVI_FILE = {"offset", "header"}
"""Of `EnviFile` what its own methods need, and the fields as text."""


def tables():
    """Return the rows of every table of the page, by heading of its second column, as dicts."""
    found = []
    for block in re.findall(r"(?:^\|.*\|\n)+", PAGE.read_text(encoding="utf-8"), re.MULTILINE):
        head, _, *rows = (
            [cell.strip() for cell in line.strip("|\n").split("|")] for line in block.splitlines()
        )
        found.append([dict(zip(head, row, strict=True)) for row in rows])
    return found


COMPARED, SAMENESS, DECLARED, OTHERS = tables()


def names_in(cell):
    return re.findall(r"`(\w+)`", cell)


def test_the_table_has_the_facts_that_are_compared_and_how():
    rows = {names_in(row["fact"])[0]: row["compared"].split(", ") for row in COMPARED}
    roles = {ALL: "all", LIT: "lit"}
    assert rows == {f.name: [roles[f.roles], *(["band"] * f.per_band)] for f in FACTS}
    assert [names_in(row["`Facts`"]) for row in COMPARED] == [list(f.fields) for f in FACTS]


def test_what_counts_as_the_same_is_said_of_every_fact():
    said = {name for row in SAMENESS for name in names_in(row["fact"])}
    others = {f.name for f in FACTS if f.compare.__name__ == "compare_equal"}
    assert said | others == {f.name for f in FACTS}


def test_every_field_that_readers_return_is_on_the_page():
    said = {name for row in (*COMPARED, *OTHERS) for name in names_in(row["`Facts`"])}
    assert said == {field.name for field in fields(Facts)}


def touched(kind):
    """Return the attributes of what readers return that modules outside `readers/` look at, by how it is named there."""
    named = {
        "facts": r"facts\)?$|facts_of\(.*\)$|read_headers\(.*\)$",
        "envi": r"(cube|scan|content|envi)$",
    }[kind]
    found = set()
    for path in HOUSE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.parent.name == "readers" or (kind == "envi" and "envi" not in text):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Attribute) and re.search(named, ast.unparse(node.value)):
                found.add(node.attr)
    return found


def test_a_fact_that_nobody_uses_is_said_to_be_ignored():
    used = touched("facts") | {name for fact in FACTS for name in fact.fields}
    unused = {field.name for field in fields(Facts)} - used
    ignored = [row for row in OTHERS if row["used for"].startswith(READING)]
    assert unused == {name for row in ignored for name in names_in(row["`Facts`"])}


def test_nothing_of_an_opened_cube_is_unused():
    unused = {field.name for field in fields(EnviFile)} - touched("envi")
    assert unused == OF_AN_ENVI_FILE
