"""The site of the documentation: it builds without a warning, and its search works from a disk."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site once, from a copy of the pages: what an earlier build left among them takes no part."""
    for package in ("sphinx", "furo", "myst_parser", "sphinxcontrib.bibtex"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed: `make` installs it, or `pip install .[docs]`")
    folder = tmp_path_factory.mktemp("documentation")
    unwanted = shutil.ignore_patterns("_build", "_generated", "__pycache__")
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=unwanted)
    shutil.copytree(ROOT / "examples", folder / "examples", ignore=unwanted)
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "site"],
        cwd=folder,
        capture_output=True,
        encoding="utf-8",
    )
    assert built.returncode == 0, built.stderr
    return folder / "site"


def test_the_site_builds_without_a_warning_and_has_every_page(site):
    pages = [p.relative_to(ROOT / "docs") for p in (ROOT / "docs").rglob("*.md")]
    written = [p for p in pages if not {"_build", "_generated"} & {*p.parts}]
    assert len(written) > 50
    for page in written:
        assert (site / page.with_suffix(".html")).is_file(), page


def test_the_site_loads_nothing_from_another_host(site):
    loaded = re.compile(r'<(?:script|img|iframe|link)\b[^>]*?(?:src|href)="(?:https?:)?//([^"]*)"')
    for page in site.rglob("*.html"):
        assert loaded.findall(page.read_text(encoding="utf-8")) == [], page


@pytest.mark.parametrize(
    ("term", "title"),
    [("demosaicing", "Registration"), ("permutation test", "Glossary"), ("curtain", "How to look")],
)
def test_the_search_finds_pages_from_a_disk(site, browser, term, title):
    page = browser.open((site / "index.html").as_uri())
    page.get_by_role("textbox", name="Search").first.fill(term)
    page.keyboard.press("Enter")
    page.wait_for_url("**/search.html?q=*")
    found = page.locator("#search-results li a").filter(has_text=re.compile(f"^{title}")).first
    found.click()
    assert title in page.title()


def test_the_search_says_that_nothing_was_found(site, browser):
    page = browser.open((site / "search.html").as_uri() + "?q=zzyzxqwv")
    page.get_by_text("did not match any documents").wait_for()
