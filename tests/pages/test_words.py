"""One word for one thing on all screens."""

import re
from pathlib import Path

import pytest

from levkas.pages.page import describe_decision
from levkas.registration.record import DECISIONS

ROOT = Path(__file__).resolve().parents[2]
OLD = (
    "accepted with a warning",
    "Accepted, please review",
    "please review",
    "Can be believed",
    "Not believed",
    "Rejected",
)
SOURCES = (
    *(ROOT / "src/levkas").rglob("*.py"),
    *(ROOT / "src/levkas").rglob("*.html"),
    *(ROOT / "frontend/src").rglob("*.ts"),
    *(ROOT / "docs").rglob("*.md"),
    ROOT / "README.md",
)


@pytest.mark.parametrize("words", OLD)
def test_no_screen_and_no_page_of_the_docs_says_what_was_said_before(words):
    reported = [str(path) for path in SOURCES if words in path.read_text(encoding="utf-8")]
    assert reported == []


def test_built_pages_say_none_of_the_old_words():
    from levkas.pages.screen import ScreenMissing, read_built

    try:
        built = [read_built(f"{name}.js") for name in ("viewer", "sheet", "workbench")]
    except ScreenMissing:
        pytest.skip("the front-end is not built: run `make frontend`")
    for data in built:
        text = data.decode("utf-8") if isinstance(data, bytes) else data
        assert not any(words in text for words in OLD)


def test_the_glossary_has_the_verdicts_of_the_one_source():
    assert len({describe_decision(key) for key in ("accept", "warn", "refuse")}) == 3
    glossary = (ROOT / "docs/screens.md").read_text(encoding="utf-8")
    for key in ("accept", "warn", "refuse", "reference"):
        assert f"| {DECISIONS[key]} |" in glossary


KEY = re.compile(r'(?:key|modeKey)\(\s*"([A-Z])"')


def letters(path):
    """The letters that a page listens to."""
    text = (ROOT / path).read_text(encoding="utf-8")
    return set(KEY.findall(text)) | set(re.findall(r'^ {2}\w+: "([A-Z])",$', text, re.M))
