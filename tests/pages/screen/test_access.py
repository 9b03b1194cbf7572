"""Both programs with the keyboard alone, for a screen reader, and for eyes that need contrast."""

import numpy as np
import pytest

from levkas.campaign.edits import read_edits

from .database import write_database
from .serving import READY, opened, pause, told
from .walking import faint, nameless, walk

pytestmark = pytest.mark.slow


def check_walk(page):
    """Tab leads to every stop once, there and back, each in view, with a ring and a name."""
    for key in ("Tab", "Shift+Tab"):
        count, met = walk(page, key)
        assert sorted(int(here["stop"]) for here in met) == list(range(count)), key
        assert [here["html"] for here in met if not (here["ring"] and here["inside"])] == []
    assert nameless(page) == []


def focused(page):
    return page.evaluate("document.activeElement.id")


@pytest.mark.parametrize("mode", ["s", "c", "k"])
def test_tab_leads_to_everything_in_the_workbench_and_out_of_it(bench, mode):
    page, _ = bench
    page.keyboard.press("w")
    page.keyboard.press(mode)
    page.wait_for_function(READY)
    check_walk(page)


def test_a_walk_sees_a_trap_a_missing_name_and_a_missing_ring(bench):
    page, _ = bench
    page.evaluate(
        """() => {
          const bare = document.querySelector('#files');
          bare.textContent = '';
          const quiet = document.querySelector('#map');
          quiet.style.outline = 'none';
          const trap = document.querySelector('#layer');
          trap.addEventListener('keydown', (e) => e.key === 'Tab' && !e.shiftKey && e.preventDefault());
        }"""
    )
    assert [role for role, _ in nameless(page)] == ["button"]
    count, met = walk(page)
    assert len({here["stop"] for here in met}) < count
    assert [here["html"][:16] for here in met if not here["ring"]] == ['<select id="map"']


def test_a_registration_is_corrected_with_the_keyboard_alone(bench):
    page, server = bench
    keys = page.keyboard
    keys.press("w")
    page.wait_for_function("() => levkasWorkbench.store.selected.value >= 0")
    page.locator("#pair-use").focus()
    keys.press("Enter")
    assert "deleted by hand" in told(page, "session.value.reason").pop(0)
    assert told(page, "selected.value") >= 0, "the next pair is chosen"
    assert page.locator("#pair-use").inner_text() == "Delete" and focused(page) == "pair-use"
    keys.press("Escape")
    assert told(page, "selected.value") == -1
    before = page.evaluate("levkasWorkbench.stage.left.centre")
    keys.press("+")
    keys.press("+")
    pause(page, 500)
    keys.press("ArrowRight")
    keys.press("ArrowDown")
    after = page.evaluate("levkasWorkbench.stage.left.centre")
    assert after[0] > before[0] + 5 and after[1] > before[1] + 5
    keys.press("i")
    page.wait_for_selector("#pair-accept")
    proposed = told(page, "proposal.value.pair")
    assert np.allclose(proposed[:2], after, atol=0.5)
    keys.press("ArrowRight")
    keys.press("Enter")
    page.wait_for_function("() => levkasWorkbench.store.proposal.value === null")
    told(page, "session.value.version")
    added = read_edits(server.edits_path).frames["icon", "xray"].added
    assert len(added) == 1 and added[0][2] == pytest.approx(proposed[2] + 0.1, abs=0.011)


def test_the_keyboard_keeps_its_place_in_groups_lists_and_dialogs(bench):
    page, _ = bench
    keys = page.keyboard
    page.locator("[data-mode=side][role=radio]").focus()
    keys.press("ArrowRight")
    assert page.evaluate("document.activeElement.dataset.mode") == "curtain"
    assert page.evaluate("levkasWorkbench.stage.mode.value") == "curtain"
    keys.press("ArrowLeft")
    page.wait_for_function(READY)
    camera = page.locator("nav button:not([aria-current])").first
    name = camera.get_attribute("id")
    camera.focus()
    keys.press("Enter")
    page.wait_for_selector(f"#{name}[aria-current=true]")
    assert focused(page) == name
    for opener in ("#files", "[aria-label='Keys and help']"):
        page.locator(opener).focus()
        keys.press("Enter")
        page.wait_for_selector("dialog[open]")
        assert page.evaluate("document.activeElement.closest('dialog') !== null")
        assert nameless(page) == []
        keys.press("Escape")
        assert page.locator("dialog[open]").count() == 0
        assert page.evaluate(f"document.activeElement.matches(`{opener}`)")


def test_all_text_of_the_workbench_can_be_read_in_light_and_dark(served, browser):
    for scheme in ("light", "dark"):
        page = opened(browser, served, scheme=scheme)
        page.keyboard.press("w")
        page.wait_for_selector("#pair-use")
        assert faint(page) == [], scheme
        for key in ("?", "Escape"):
            page.keyboard.press(key)
        page.keyboard.press("?")
        assert faint(page) == [], scheme
        page.evaluate("document.documentElement.style.setProperty('--soft', '#787878')")
        assert faint(page) != [], "what cannot be read is seen"


@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon1/index.html"])
def test_tab_leads_to_everything_in_the_viewer_and_all_text_can_be_read(browser, address, name):
    for scheme in ("light", "dark"):
        page = browser.open(address("file", name), scheme=scheme)
        pause(page, 400)
        assert faint(page) == [], scheme
    check_walk(page)
    if "objects" not in name:
        return
    for key in ("c", "k", "s", "d"):
        page.keyboard.press(key)
        pause(page, 200)
        assert faint(page) == [], key
    check_walk(page)
    for fold in page.locator("details").all():
        fold.locator("summary").first.press("Enter")
    assert page.locator("details:not([open])").count() == 0
    assert faint(page) == []
    check_walk(page)


@pytest.mark.parametrize("name", ["README.html", "ro-crate-preview.html"])
def test_tab_leads_through_the_pages_about_a_publication(browser, publish_with, tmp_path, name):
    database = write_database(tmp_path / "database", {"icon1": "First icon"})
    folder = publish_with(database, "A small database", "Ada Painter")
    for width, scheme in ((1280, "light"), (390, "dark")):
        page = browser.open((folder / name).as_uri(), width=width, scheme=scheme)
        for fold in page.locator("details > summary").all():
            if fold.is_visible():
                fold.press("Enter")
        assert faint(page) == [], scheme
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
        check_walk(page)
