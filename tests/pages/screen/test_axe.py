"""No violation of axe-core's rules on any page, light and dark, wide and narrow, folded and open."""

from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe

from .serving import READY, opened, pause
from .walking import nameless, walk

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
def written(world, tmp_path_factory):
    """The report, the pages of cameras and of charts that a build wrote, and a plan."""
    from levkas.pages.plan import write_report
    from levkas.planning import load_setup

    bench = Path(__file__).parents[3] / "examples/plan/bench.toml"
    plan = write_report(tmp_path_factory.mktemp("plan") / "plan.html", load_setup(bench))
    return [plan, *sorted(world.database.rglob("*.html"))]


def test_no_page_of_one_file_breaks_a_rule_or_is_wider_than_the_window(browser, written):
    assert len(written) >= 3
    for path in written:
        for width, scheme in SIZES:
            page = browser.open(path.as_uri(), width=width, scheme=scheme)
            unfold(page)
            assert violations(page) == [], (path.name, width, scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.evaluate("document.querySelector('main').innerHTML += '<img src=\"data:,\">'")
    assert "image-alt" in [rule for rule, _, _ in violations(page)]


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


def check_walk(page):
    """Tab leads to every stop once, there and back, each in view, with a ring and a name."""
    for key in ("Tab", "Shift+Tab"):
        count, met = walk(page, key)
        assert sorted(int(here["stop"]) for here in met) == list(range(count)), key
        assert [here["html"] for here in met if not (here["ring"] and here["inside"])] == []
    assert nameless(page) == []


def test_tab_leads_to_everything_in_the_workbench_and_a_trap_is_seen(bench):
    page, _ = bench
    page.keyboard.press("w")
    for mode in "sk":
        page.keyboard.press(mode)
        page.wait_for_function(READY)
        check_walk(page)
    page.evaluate(
        """() => { const bare = document.querySelector('#files'); bare.textContent = '';
          const trap = document.querySelector('#map'); trap.style.outline = 'none';
          trap.addEventListener('keydown', (e) => e.key === 'Tab' && !e.shiftKey && e.preventDefault()); }"""
    )
    assert [role for role, _ in nameless(page)] == ["button"]
    count, met = walk(page)
    assert len({here["stop"] for here in met}) < count
    assert {here["html"][:16] for here in met if not here["ring"]} == {'<select id="map"'}


@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon1/index.html"])
def test_tab_leads_to_everything_in_the_viewer(browser, address, name):
    page = browser.open(address("file", name))
    pause(page, 400)
    check_walk(page)
    if "objects" in name:
        page.keyboard.press("k")
        unfold(page)
        check_walk(page)
