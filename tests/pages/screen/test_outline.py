"""The outline of the object, drawn and corrected in the workbench, in a real browser."""

import numpy as np
import pytest

from levkas.campaign.edits import read_edits

from .serving import pause, told

SHAPE = [[60.0, 50.0], [360.0, 60.0], [350.0, 290.0], [70.0, 280.0]]


def place(page, x, y):
    return page.evaluate(f"levkasWorkbench.stage.left.pageOf({x}, {y})")


def click(page, x, y):
    page.mouse.click(*place(page, x, y))


def drawn(server):
    return read_edits(server.edits_path).outlines.get("icon", ())


def draw(page):
    """Open the tool and click all corners; the first again closes the outline."""
    page.locator("#outline").click()
    for corner in [*SHAPE, SHAPE[0]]:
        click(page, *corner)
    assert told(page, "refused.value") == ""


def test_an_outline_is_drawn_corrected_undone_and_removed(bench):
    page, server = bench
    draw(page)
    assert np.abs(np.array(drawn(server)) - SHAPE).max() < 1.0
    assert "4 corners, drawn by hand" in page.locator("#outline-state").inner_text()
    assert told(page, "stale.value") is True
    # Its second corner is dragged, a side gets a corner, the keyboard moves it.
    page.mouse.move(*place(page, *drawn(server)[1]))
    page.mouse.down()
    page.mouse.move(*place(page, 380, 40), steps=5)
    page.mouse.up()
    told(page, "refused.value")
    assert np.abs(np.array(drawn(server)[1]) - (380, 40)).max() < 1.0
    click(page, 210, 285)
    told(page, "refused.value")
    added = np.array(drawn(server)[3])
    assert len(drawn(server)) == 5 and np.abs(added - (210, 285)).max() < 6.0
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Shift+ArrowRight")
    told(page, "refused.value")
    assert np.array(drawn(server)[3]) == pytest.approx(added + np.array([10, 1]), abs=0.02)
    page.keyboard.press("Delete")
    told(page, "refused.value")
    assert len(drawn(server)) == 4
    for _ in range(5):
        page.keyboard.press("Control+z")
    told(page, "refused.value")
    assert np.abs(np.array(drawn(server)) - SHAPE).max() < 1.0
    page.locator("#outline-remove").click()
    told(page, "refused.value")
    assert drawn(server) == () and told(page, "stale.value") is False


def test_an_outline_that_crosses_itself_is_refused_in_words_and_stays_open(bench, browser):
    page, server = bench
    page.locator("#outline").click()
    for corner in ([60, 50], [350, 290], [350, 60], [60, 280]):
        click(page, *corner)
    page.keyboard.press("Enter")
    assert "must not cross or touch itself" in told(page, "refused.value")
    assert page.locator("#refused").is_visible() and drawn(server) == ()
    assert "4 corners drawn" in page.locator("#outline-state").inner_text()
    page.keyboard.press("Delete")
    page.keyboard.press("Enter")
    assert told(page, "refused.value") == "" and len(drawn(server)) == 3
    assert all("422" in error for error in browser.errors)
    browser.errors.clear()


def test_the_outline_is_drawn_with_the_keyboard_alone(bench):
    page, server = bench
    page.locator("#outline").focus()
    page.keyboard.press("Enter")
    page.evaluate("document.activeElement.blur()")
    for steps in ([], ["Shift+ArrowRight"] * 9, ["Shift+ArrowDown"] * 9):
        page.keyboard.press("i")
        for key in steps:
            page.keyboard.press(key)
    page.keyboard.press("Enter")
    assert told(page, "refused.value") == ""
    first, second, third = np.array(drawn(server))
    assert second - first == pytest.approx((90, 0), abs=0.1)
    assert third - first == pytest.approx((0, 90), abs=0.1)
    page.keyboard.press("Escape")
    assert page.locator(".outline").is_hidden()


def test_clicks_are_of_the_outline_while_it_is_open_and_of_pairs_again_afterwards(bench):
    page, server = bench
    draw(page)
    click(page, 200, 170)
    pause(page, 100)
    assert told(page, "proposal.value") is None and len(drawn(server)) == 4
    page.locator("#outline-done").click()
    page.keyboard.press("w")
    page.wait_for_function("() => levkasWorkbench.store.selected.value >= 0")
