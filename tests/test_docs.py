import pkgutil
import re
import sys
import tomllib
from pathlib import Path

import levkas

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
WORDS = 1500
REFERENCE = {"api.md", "benchmarks.md", "campaign.md", "commands.md"}
REFERENCE_FOLDERS = (DOCS / "reference",)
"""Pages in which one looks things up: no limit of words."""


def pages():
    """Return the pages that people write."""
    return {p for p in DOCS.rglob("*.md") if not {"_build", "_generated"} & {*p.parts}}


def test_the_command_reference_is_what_the_commands_say(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    sys.modules.pop("write_commands", None)
    from write_commands import reference

    assert (DOCS / "commands.md").read_text(encoding="utf-8") == reference()


def test_every_public_name_loads_and_is_in_the_documentation():
    text = "\n".join(p.read_text(encoding="utf-8") for p in pages())
    for name in levkas.__all__:
        assert getattr(levkas, name) is not None
        assert name in text, name


def test_the_reference_of_python_has_every_public_name_whole():
    text = (DOCS / "reference/public_names.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\.\. auto(?:function|class):: levkas\.(\w+)$", text, re.MULTILINE)
    assert sorted(shown) == sorted({*levkas.__all__} - {"__version__"})


def test_every_page_of_the_documentation_is_in_one_list_of_pages():
    listed = []
    for index in pages():
        text = index.read_text(encoding="utf-8")
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            names = [n for n in block.splitlines() if n and not n.startswith(":")]
            paths = [index.parent / f"{name}.md" for name in names]
            listed += [p.resolve() for path in paths for p in path.parent.glob(path.name)]
    assert sorted(listed) == sorted(pages() - {DOCS / "index.md"})


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
    drawn = (DOCS / "development/architecture.md").read_text(encoding="utf-8").split("```")[1]
    assert {*place} <= {*re.findall(r"\w+", drawn)}


def test_pages_for_developers_name_files_that_are_there():
    for page in (ROOT / "CONTRIBUTING.md", DOCS / "development/architecture.md"):
        names = re.findall(r"`(\w+(?:/\w+)+\.py)`", page.read_text(encoding="utf-8"))
        roots = (ROOT, ROOT / "src", ROOT / "src/levkas", ROOT / "tests")
        there = [n for n in names if any((root / n).is_file() for root in roots)]
        assert [n for n in names if n not in there and not re.search("[A-Z]", n)] == []
        folders = [Path(n).parent for n in names if n not in there]
        assert all(any((root / folder).is_dir() for root in roots) for folder in folders)
        rows = re.findall(r"`FORMS` of `([\w/]+\.py)`", page.read_text(encoding="utf-8"))
        assert all((ROOT / "src/levkas" / row).is_file() for row in rows)


def anchors(page):
    """Return the anchors of the headings of a page, as GitHub and MyST make them."""
    text = re.sub(r"^(`{3,}).*?^\1$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    plain = [
        re.sub(r"\]\([^)]*\)|[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
    ]
    return {*plain, *re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE)}


def test_links_of_pages_lead_to_files_and_headings():
    named = [ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")]
    found = 0
    for page in (*pages(), *named):
        text = page.read_text(encoding="utf-8")
        for path, anchor in re.findall(r"\]\(([^)#:\s]*)(?:#([^)\s]*))?\)", text):
            target = (page.parent / path) if path else page
            assert target.exists(), f"{page}: {path}"
            if anchor and target.suffix == ".md":
                assert anchor in anchors(target), f"{page}: {path}#{anchor}"
            found += 1
    assert found > 100


def test_a_page_that_one_reads_is_short():
    for page in (*pages(), ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        words = [w for w in page.read_text(encoding="utf-8").split() if re.search(r"\w", w)]
        looked_up = page.name in REFERENCE or page.parent in REFERENCE_FOLDERS
        assert looked_up or len(words) <= WORDS, f"{page}: {len(words)} words"


def test_the_lock_file_names_no_registry_and_pins_by_hash():
    for name in ("requirements-use.lock", "requirements-peers.lock", "requirements-fuzz.lock"):
        assert "://" not in (ROOT / name).read_text()
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text and text.count("--hash=sha256:") > 300


def test_names_of_python_lead_to_their_entries_and_words_do_not(tmp_path):
    from sphinx.application import Sphinx

    (tmp_path / "index.md").write_text(
        "# Page\n\nCall `levkas.open`, `read_stiff` or `levkas.Flag(4)`, not `open`, not `levkas.nothing`.\n\n"
        "```{eval-rst}\n.. autofunction:: levkas.open\n.. autofunction:: levkas.read_stiff\n"
        ".. autoclass:: levkas.Flag\n```\n"
    )
    place = {name: tmp_path / name for name in ("out", "trees")}
    plain = {"bibtex_bibfiles": [], "autosummary_generate": False, "html_theme": "basic"}
    app = Sphinx(tmp_path, DOCS, *place.values(), "html", plain, status=None, warning=None)
    app.build()
    page = (place["out"] / "index.html").read_text(encoding="utf-8").partition("</p>")[0]
    linked = re.findall(r'href="#(levkas\.\w+)"[^>]*><code[^>]*><span class="pre">([^<]+)', page)
    assert linked == [
        ("levkas.open", "levkas.open"),
        ("levkas.read_stiff", "read_stiff"),
        ("levkas.Flag", "levkas.Flag(4)"),
    ]


def test_names_of_python_that_pages_mention_are_there():
    found = 0
    for page in pages():
        for name in re.findall(r"`levkas((?:\.[a-z_A-Z]\w*)+)[`(]", page.read_text("utf-8")):
            if name in {".py", ".NAME"}:
                continue
            pkgutil.resolve_name("levkas" + name)
            found += 1
    assert found > 40
