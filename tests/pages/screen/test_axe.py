"""No violation of axe-core's rules on any page, light and dark, wide and narrow, folded and open."""

import pytest
from axe_playwright_python.sync_playwright import Axe

from .kinds import KINDS, write_kinds
from .serving import READY, opened, pause

pytestmark = pytest.mark.slow
# 1280 px enlarged to 400 % are 320 px.
SIZES = ((1440, "light"), (820, "dark"), (320, "light"))


def violations(page):
    """What axe-core finds: rule, how many elements, and the first of them."""
    # Style sheets are not asked for again: the pages' own policy forbids that. Sizes of targets are new in WCAG 2.2.
    options = {"resultTypes": ["violations"], "preload": False}
    found = Axe().run(page, options={**options, "rules": {"target-size": {"enabled": True}}})
    return [
        (v["id"], len(v["nodes"]), v["nodes"][0]["html"][:120])
        for v in found.response["violations"]
    ]


def unfold(page):
    for fold in page.locator("details:not([open]) > summary").all():
        if fold.is_visible():
            fold.click()


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    return write_kinds(tmp_path_factory.mktemp("kinds"))


@pytest.mark.parametrize("kind", KINDS)
def test_no_page_of_one_file_breaks_a_rule_or_is_wider_than_the_window(browser, kinds, kind):
    for width, scheme in SIZES:
        page = browser.open(kinds[kind].as_uri(), width=width, scheme=scheme)
        unfold(page)
        assert violations(page) == [], (width, scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_rule_that_is_broken_is_seen(browser, kinds):
    page = browser.open(kinds["plan"].as_uri())
    page.evaluate("document.querySelector('figure').innerHTML = '<img src=\"data:,\">'")
    assert [rule for rule, _, _ in violations(page)] == ["image-alt"]


@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon1/index.html"])
def test_no_page_of_the_viewer_breaks_a_rule(browser, address, name):
    for width, scheme in SIZES:
        page = browser.open(address("file", name), width=width, scheme=scheme)
        pause(page, 500)
        unfold(page)
        assert violations(page) == [], (width, scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page = browser.open(address("file", name), width=1440)
    for key in ("c", "s", "d", "?") if "objects" in name else ():
        page.keyboard.press(key)
        pause(page, 400)
        assert violations(page) == [], key


def test_the_workbench_breaks_no_rule(served, browser):
    for width, scheme in SIZES:
        page = opened(browser, served, width=width, scheme=scheme)
        page.keyboard.press("w")
        page.wait_for_selector("#pair-use")
        unfold(page)
        assert violations(page) == [], (width, scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.keyboard.press("Escape")
        for key in ("c", "k", "d", "s"):
            page.keyboard.press(key)
            page.wait_for_function(READY)
            assert violations(page) == [], key
        page.keyboard.press("i")
        page.wait_for_selector("#pair-accept")
        assert violations(page) == []
        page.keyboard.press("?")
        assert violations(page) == []
