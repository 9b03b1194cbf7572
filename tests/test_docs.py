"""The pages: links, commands, names, paths and examples lead to what is there, as the program itself reads them."""

import ast
import doctest
import pkgutil
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import typer
import typer.main

import levkas
from levkas.cli import app

GROUP = typer.main.get_command(app)
ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
WORDS = 1500
LOOKED_UP = {"api.md", "benchmarks.md", "campaign.md", "commands.md"}
"""Pages in which one looks things up, as in docs/reference: no limit of words."""
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "_generated"} & {*p.parts})
READ = [*PAGES, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md"))]
FENCE = re.compile(r"^(?P<ticks>`{3,})(?P<kind>[^\n]*)\n(?P<text>.*?)^(?P=ticks)$", re.M | re.S)
PATH = re.compile(r"(?<![\w/.-])((?:tests|benchmarks|examples|docs|src|frontend)/[\w/.*-]*\w)")
SIGNATURE = re.compile(r"^levkas\.(\w+\([^()]*\*, [^()]*\))$")
ELSEWHERE = {"examples/two-paintings", "examples/envi-linescan", "examples/silios-kinect"}
"""Campaigns of captures that are not in the repository."""
UsageError = typer.BadParameter.__base__

each_page = pytest.mark.parametrize("page", READ, ids=lambda p: str(p.relative_to(ROOT)))


def blocks(text, *kinds):
    """Return the texts of fenced blocks of these kinds."""
    return [m["text"] for m in FENCE.finditer(text) if m["kind"].strip() in kinds]


def commands(page):
    """Return the command lines of a page, and whether each is complete: those of blocks are."""
    text = page.read_text(encoding="utf-8")
    found = []
    for block in blocks(text, "sh", "text", "console", ""):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.sub(r"^\S*\$ ", "", line).split("&&"):
                if part.strip().startswith("levkas "):
                    found.append((part.strip().removesuffix("&"), True))
    inline = re.finditer(r"(?<!`)`(levkas [^`]+)`(?!`)", FENCE.sub("", text))
    found += [(" ".join(m[1].split()), False) for m in inline]
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
    try:
        command.parse_args(context, words) if whole else command.make_parser(context).parse_args(
            words
        )
    except UsageError as problem:
        if whole or "requires an argument" not in problem.message:
            raise


def anchors(page):
    """Return the anchors of the headings of a page, as GitHub and MyST make them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    plain = {
        re.sub(r"\]\([^)]*\)|[^\w\- ]", "", title.lower()).replace(" ", "-")
        for title in re.findall(r"^#+ (.*)$", text, re.M)
    }
    return plain | {*re.findall(r"^\(([\w-]+)\)=$", text, re.M)}


@each_page
def test_commands_of_a_page_exist_with_their_options(page):
    for line, whole in commands(page):
        try:
            parse(line, whole=whole)
        except UsageError as problem:
            pytest.fail(f"{page}: {line}: {problem.format_message()}")


@pytest.mark.parametrize(
    "line",
    ["levkas biuld FOLDER", "levkas build FOLDER --threds 2", "levkas plan lights", "levkas build"],
)
def test_a_command_that_does_not_exist_is_found(line):
    assert sum(len(commands(page)) for page in READ) > 100
    with pytest.raises(UsageError):
        parse(line, whole=True)


@each_page
def test_links_paths_and_names_of_a_page_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for path, anchor in re.findall(r"\]\(([^)#:\s]*)(?:#([^)\s]*))?\)", text):
        target = (page.parent / path) if path else page
        assert target.exists(), path
        assert not anchor or target.suffix != ".md" or anchor in anchors(target), f"{path}#{anchor}"
    for path in {m[1] for m in PATH.finditer(text)} - ELSEWHERE:
        assert any(ROOT.glob(path)) or any(page.parent.glob(path)), path
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
    assert {*re.findall(r"`make ([a-z][a-z-]*)", text)} <= {*targets}
    for name in re.findall(r"`levkas((?:\.[a-z_A-Z]\w*)+)[`(]", text):
        if name not in {".py", ".NAME"}:
            pkgutil.resolve_name("levkas" + name)


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


@each_page
def test_a_page_that_one_reads_is_short(page):
    words = [w for w in page.read_text(encoding="utf-8").split() if re.search(r"\w", w)]
    looked_up = page.name in LOOKED_UP or page.parent == DOCS / "reference"
    assert looked_up or len(words) <= WORDS


def test_every_page_of_the_documentation_is_in_one_list_of_pages():
    listed = []
    for index in PAGES:
        for block in blocks(index.read_text(encoding="utf-8"), "{toctree}"):
            names = [n for n in block.splitlines() if n and not n.startswith(":")]
            paths = [index.parent / f"{name}.md" for name in names]
            listed += [p.resolve() for path in paths for p in path.parent.glob(path.name)]
    assert sorted(listed) == sorted({*PAGES} - {DOCS / "index.md"})


def test_pages_that_the_program_names_exist():
    named = set()
    for path in (ROOT / "src").rglob("*"):
        if path.suffix in {".py", ".html"}:
            named |= {*re.findall(r"docs/[\w/]+\.md", path.read_text(encoding="utf-8"))}
    assert named and [name for name in named if not (ROOT / name).is_file()] == []


def test_the_command_reference_is_what_the_commands_say(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    sys.modules.pop("write_commands", None)
    from write_commands import reference

    assert (DOCS / "commands.md").read_text(encoding="utf-8") == reference()


def test_the_reference_of_python_has_every_public_name_whole():
    text = (DOCS / "reference/public_names.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\.\. auto(?:function|class):: levkas\.(\w+)$", text, re.MULTILINE)
    assert sorted(shown) == sorted({*levkas.__all__} - {"__version__"})


def test_the_pages_on_the_packages_list_them_as_their_imports_are_checked():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = contracts["tool"]["importlinter"]["contracts"]
    layers = [{*re.findall(r"levkas\.(\w+)", layer)} for layer in contract["layers"]]
    place = {name: n for n, layer in enumerate(layers) for name in layer}
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`\w+`(?: · `\w+`)*) \|", text, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row) if name in place]
    assert sorted(named) == sorted(place)
    assert [place[name] for name in named] == sorted(place.values())
