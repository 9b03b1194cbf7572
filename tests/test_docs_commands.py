"""Commands, paths and examples that pages name: parsed by the program itself, looked for in the repository."""

import ast
import doctest
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer
import typer.main

from levkas.cli import app

GROUP = typer.main.get_command(app)
ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ROOT_PAGES = tuple(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))
FENCE = re.compile(r"^(?P<ticks>`{3,})(?P<kind>[^\n]*)\n(?P<text>.*?)^(?P=ticks)$", re.M | re.S)
UsageError = typer.BadParameter.__base__
INLINE = re.compile(r"(?<!`)`(levkas [^`]+)`(?!`)")
PROMPT = re.compile(r"^\S*\$ ")
PATH = re.compile(r"(?<![\w/.-])((?:tests|benchmarks|examples|docs|src|frontend)/[\w/.*-]*\w)")
SIGNATURE = re.compile(r"^levkas\.(\w+\([^()]*\*, [^()]*\))$")
"""Pages whose examples `test_reference.py` runs, on a database."""
ELSEWHERE = {"examples/two-paintings", "examples/envi-linescan", "examples/silios-kinect"}
"""Campaigns of captures that are not in the repository."""


def pages():
    """Return the pages that people write."""
    found = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "_generated"} & {*p.parts})
    return [p for p in found if p.name != "commands.md"] + list(ROOT_PAGES)


each_page = pytest.mark.parametrize("page", pages(), ids=lambda p: str(p.relative_to(ROOT)))


def blocks(text, *kinds):
    """Return the texts of fenced blocks of these kinds."""
    return [m["text"] for m in FENCE.finditer(text) if m["kind"].strip() in kinds]


def commands(page):
    """Return the command lines of a page, and whether each is complete: those of blocks are."""
    text = page.read_text(encoding="utf-8")
    found = []
    for block in blocks(text, "sh", "text", "console", ""):
        for line in block.replace("\\\n", " ").splitlines():
            for part in PROMPT.sub("", line).split("&&"):
                if part.strip().startswith("levkas "):
                    found.append((part.strip().removesuffix("&"), True))
    found += [(" ".join(m[1].split()), False) for m in INLINE.finditer(FENCE.sub("", text))]
    return [(line, whole) for line, whole in found if "COMMAND" not in line]


def parse(line, *, whole):
    """Parse a command line as the program does; of one that is not whole only names of commands and options."""
    command, parent, name = GROUP, None, "levkas"
    words = shlex.split(line, comments=True)[1:]
    while hasattr(command, "commands"):
        context = command.context_class(command, info_name=name, parent=parent)
        words = command.make_parser(context).parse_args(words)[1]
        if not words:
            return
        name, command, words = command.resolve_command(context, words)
        parent = context
    context = command.context_class(command, info_name=name, parent=parent)
    if whole:
        command.parse_args(context, words)
        return
    try:
        command.make_parser(context).parse_args(words)
    except UsageError as problem:
        if "requires an argument" not in problem.message:
            raise


@each_page
def test_commands_of_a_page_exist_with_their_options(page):
    if page.name == "CHANGELOG.md":
        pytest.skip("it names commands that are gone")
    for line, whole in commands(page):
        try:
            parse(line, whole=whole)
        except UsageError as problem:
            pytest.fail(f"{page}: {line}: {problem.format_message()}")


def test_enough_commands_were_found():
    assert sum(len(commands(page)) for page in pages()) > 100


@pytest.mark.parametrize(
    "line",
    ["levkas biuld FOLDER", "levkas build FOLDER --threds 2", "levkas plan lights", "levkas build"],
)
def test_a_command_that_does_not_exist_is_found(line):
    with pytest.raises(UsageError):
        parse(line, whole=True)


@each_page
def test_paths_and_make_targets_of_a_page_exist(page):
    if page.name == "CHANGELOG.md":
        pytest.skip("what a release had may be gone")
    text = page.read_text(encoding="utf-8")
    for path in {m[1] for m in PATH.finditer(text)} - ELSEWHERE:
        assert any(ROOT.glob(path)) or any(page.parent.glob(path)), path
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
    assert {*re.findall(r"`make ([a-z][a-z-]*)", text)} <= {*targets}


def test_pages_that_the_program_names_exist():
    named = set()
    for path in (ROOT / "src").rglob("*"):
        if path.suffix in {".py", ".html"}:
            named |= {*re.findall(r"docs/[\w/]+\.md", path.read_text(encoding="utf-8"))}
    assert len(named) > 4
    assert [name for name in named if not (ROOT / name).is_file()] == []


@each_page
def test_examples_of_a_page_are_well_formed_and_do_what_they_show(page, tmp_path, monkeypatch):
    text = page.read_text(encoding="utf-8")
    for block in blocks(text, "python"):
        ast.parse(SIGNATURE.sub(r"def \1: ...", block.strip()))
    for block in blocks(text, "toml"):
        tomllib.loads(block)
    typed = blocks(text, "pycon")
    assert len(typed) == text.count("```pycon")
    if typed:
        monkeypatch.chdir(tmp_path)
        flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
        test = doctest.DocTestParser().get_doctest("\n".join(typed), {}, page.name, str(page), 0)
        assert doctest.DocTestRunner(optionflags=flags).run(test).failed == 0
