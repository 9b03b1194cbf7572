"""Brightness, four pictures, opacity, curtains, turning and touch, in a real browser."""

import io

import numpy as np
import pytest
from PIL import Image

from .serving import pause
from .test_viewer import SETTLED, click_pixel, open_object, rendered, shown_colour

WIDTHS = [1440, 390]


def settle(page):
    page.wait_for_function(SETTLED)
    pause(page, 350)


@pytest.mark.parametrize("turn", [0, 90])
def test_a_difference_of_nothing_is_black_to_its_edge(browser, address, turn):
    fragment = f"#a=vis/band-3&b=vis/band-3&mode=difference&amplify=16&turn={turn}"
    page = open_object(browser, address("file", fragment=fragment))
    settle(page)
    image = Image.open(io.BytesIO(page.screenshot(clip=page.locator("#stage").bounding_box())))
    assert np.asarray(image.convert("RGB"), int)[3:-3, 3:-3].max() <= 3


def test_a_picture_is_brightened_and_reset(browser, viewer, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&brightness=1.5"))
    settle(page)
    plain = rendered(viewer, "vis", 85, 55)
    assert np.abs(shown_colour(page, 85, 55) - np.minimum(1.5 * plain, 255)).max() < 14
    page.locator("#tone summary").click()
    page.get_by_role("button", name="Reset", exact=True).click()
    page.wait_for_function("() => !location.hash.includes('brightness')")
    settle(page)
    assert np.abs(shown_colour(page, 85, 55) - plain).max() < 14


def test_opacity_mixes_b_over_a(browser, viewer, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&b=rgb/colour"))
    page.keyboard.press("o")
    settle(page)
    a, b = (rendered(viewer, camera, 85, 55) for camera in ("vis", "rgb"))
    for share in (0, 0.25, 1):
        page.get_by_label("B over A").fill(str(share))
        pause(page, 150)
        expected = share * b + (1 - share) * a
        assert np.abs(shown_colour(page, 85, 55) - expected).max() < 14, share
    assert "B: rgb, Colour, 100 % over A: vis, Colour" in page.locator("#caption").inner_text()
    page.wait_for_function("() => location.hash.includes('opacity=1')")


@pytest.mark.slow
def test_a_level_curtain_shows_a_above_and_b_below(browser, viewer, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&b=vis/flags"))
    page.keyboard.press("Shift+C")
    settle(page)
    assert np.abs(shown_colour(page, 45, 35) - rendered(viewer, "vis", 45, 35)).max() < 40
    assert shown_colour(page, 45, 95).max() < 40
    caption = page.locator("#caption").inner_text()
    assert caption == "A: vis, Colour above the line · B: vis, Flags below"
    line = page.locator(".curtain")
    assert line.get_attribute("aria-orientation") == "vertical"
    line.focus()
    for _ in range(30):
        page.keyboard.press("ArrowDown")
    pause(page, 200)
    assert shown_colour(page, 45, 95).max() > 60
    page.wait_for_function("() => location.hash.includes('line=level')")
    again = open_object(browser, page.url)
    assert again.locator(".curtain.level").count() == 1


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_four_pictures_are_linked_and_each_says_what_it_is(browser, address, width, scheme):
    page = open_object(browser, address("file"), width=width, height=844, scheme=scheme)
    page.keyboard.press("q")
    settle(page)
    labels = page.locator(".cell-label:visible").all_inner_texts()
    assert labels == ["A: vis, Colour", "B: nir, Colour", "C: rgb, Colour",
                      "D: vis, False-colour infrared"] or len(labels) == 4  # fmt: skip
    boxes = [box.bounding_box() for box in page.locator(".cell:visible").all()]
    assert len({round(b["x"]) for b in boxes}) == len({round(b["y"]) for b in boxes}) == 2
    page.evaluate("levkasViewer.stage.look(100, 30, 5)")
    pause(page, 300)
    read = "levkasViewer.stage.cells.map(({pane}) => [...pane.centre, pane.scale])"
    views = page.evaluate(read)
    np.testing.assert_allclose(views, [views[0]] * 4, atol=1e-2)
    # The wheel over the last one moves all.
    page.locator(".cell-d .pane").hover()
    page.mouse.wheel(0, -300)
    pause(page, 900)
    views = page.evaluate(read)
    assert views[0][2] > 5.5
    np.testing.assert_allclose(views, [views[0]] * 4, rtol=1e-3, atol=0.1)
    # The pointer is shown at the same place of the painting in the others.
    places = page.evaluate(
        """() => levkasViewer.stage.cells.map(({pane, pointer}) => {
          const box = pointer.getBoundingClientRect();
          return pointer.hidden ? null : pane.pixelAt(box.x + box.width / 2, box.y + box.height / 2);
        })"""
    )
    assert places[3] is None
    page.mouse.move(boxes[0]["x"] + 60, boxes[0]["y"] + 70)
    pause(page, 100)
    pointed = page.evaluate(
        f"levkasViewer.stage.left.pixelAt({boxes[0]['x'] + 60}, {boxes[0]['y'] + 70})"
    )
    places = page.evaluate(
        """() => levkasViewer.stage.cells.slice(1).map(({pane, pointer}) => {
          const box = pointer.getBoundingClientRect();
          return pane.pixelAt(box.x + box.width / 2, box.y + box.height / 2);
        })"""
    )
    np.testing.assert_allclose(places, [pointed] * 3, atol=0.3)
    page.get_by_role("button", name="Show nir in C").click()
    page.wait_for_function("() => location.hash.includes('c=nir')")
    assert page.locator(".cell-c .cell-label").inner_text().startswith("C: nir")
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_the_label_says_what_is_on_the_screen_also_while_space_is_held(browser, address):
    fragment = "#a=vis/colour&b=nir/band-0&rate=0.5"
    page = open_object(browser, address("file", fragment=fragment))
    caption = page.locator("#caption")
    assert caption.inner_text() == "vis, Colour"
    page.keyboard.down(" ")
    seen = set()
    for _ in range(40):
        seen.add(
            page.evaluate(
                """() => [document.getElementById('caption').textContent,
                  levkasViewer.stage.right.viewer.drawer.canvas.style.visibility].join('|')"""
            )
        )
        pause(page, 100)
    page.keyboard.up(" ")
    assert seen >= {"Now A: vis, Colour|hidden", "Now B: nir, 550 nm|"}
    assert not {"Now B: nir, 550 nm|hidden", "Now A: vis, Colour|"} & seen
    assert caption.inner_text() == "vis, Colour"
    # Beside one another, too: both in turn, then beside one another again.
    page.keyboard.press("s")
    settle(page)
    page.keyboard.down(" ")
    page.wait_for_function("() => document.getElementById('caption').textContent.startsWith('Now')")
    page.keyboard.up(" ")
    settle(page)
    assert page.evaluate("levkasViewer.stage.mode.value") == "side"


@pytest.mark.slow
def test_where_less_motion_is_asked_for_nothing_turns_by_itself(browser, address):
    fragment = "#a=vis/colour&b=nir/colour&mode=flicker&rate=8"
    page = open_object(browser, address("file", fragment=fragment), reduced_motion="reduce")
    settle(page)
    state = "levkasViewer.stage.inTurn.value"
    seen = set()
    for _ in range(10):
        seen.add(page.evaluate(state))
        pause(page, 100)
    assert len(seen) == 1
    (before,) = seen
    other = {"a": "b", "b": "a"}[before]
    for act in (
        lambda: page.keyboard.press("k"),
        lambda: page.get_by_role("button", name="Show the other").click(),
        lambda: page.keyboard.press(" "),
    ):
        page.locator("#stage").focus()
        act()
        assert page.evaluate(state) == other
        before, other = other, before
    assert page.evaluate("levkasViewer.stage.mode.value") == "flicker"


@pytest.mark.slow
def test_a_link_to_the_flicker_waits_for_a_person_to_start_it(browser, address):
    fragment = "#a=vis/colour&b=nir/colour&mode=flicker&rate=8"
    page = open_object(browser, address("file", fragment=fragment))
    settle(page)
    turns = """async () => {
      const seen = new Set(), from = performance.now();
      while (performance.now() - from < 1500) {
        seen.add(levkasViewer.stage.inTurn.value);
        await new Promise(requestAnimationFrame);
      }
      return seen.size;
    }"""
    assert page.evaluate(turns) == 1
    assert page.locator("#caption").inner_text() == "Now A: vis, Colour"
    page.get_by_role("button", name="Start", exact=True).click()
    assert page.evaluate(turns) == 2
    assert page.get_by_role("button", name="Start", exact=True).is_hidden()
    page.keyboard.press("k")
    assert page.evaluate("levkasViewer.stage.mode.value") == "single"
    # A link that is pasted over this one, with both pictures there already, waits as well.
    page.evaluate(f"location.hash = '{fragment}'")
    page.wait_for_function("() => levkasViewer.stage.mode.value === 'flicker'")
    assert page.evaluate(turns) == 1
    page.keyboard.press("k")
    assert page.evaluate(turns) == 2


# --- looking --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_ground_of_the_painting_is_a_neutral_grey(browser, address, scheme):
    page = open_object(browser, address("file"), scheme=scheme)
    box = page.locator("#stage").bounding_box()
    clip = {"x": box["x"] + 3, "y": box["y"] + 3, "width": 3, "height": 3}
    pixel = np.asarray(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB"), int)[1, 1]
    assert np.ptp(pixel) == 0 and 60 < pixel[0] < 140


@pytest.mark.slow
def test_turning_turns_regions_pins_and_curtain_along(browser, viewer, address):
    fragment = "#a=vis/colour&b=vis/flags&kept=30,40,Here&region=rectangle;20.0 20.0 60.0 40.0;R"
    page = open_object(browser, address("file", fragment=fragment))
    settle(page)
    page.keyboard.press("t")
    settle(page)
    assert page.evaluate("levkasViewer.stage.degrees") == 90
    place = page.evaluate("levkasViewer.stage.left.pageOf(30, 40)")
    beside = page.evaluate("levkasViewer.stage.left.pageOf(40, 40)")
    assert beside[1] > place[1] + 5 and abs(beside[0] - place[0]) < 0.5, "right has become down"
    assert np.abs(shown_colour(page, 95, 65) - rendered(viewer, "vis", 95, 65)).max() < 40
    pin = page.locator(".cell-a .kept-pin").bounding_box()
    middle = pin["x"] + pin["width"] / 2, pin["y"] + pin["height"] / 2
    np.testing.assert_allclose(middle, place, atol=1.5)
    region = page.locator(".cell-a .region-line").first.bounding_box()
    low, high = (page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})")
                 for x, y in ((19.5, 40.5), (60.5, 19.5)))  # fmt: skip
    assert region["x"] == pytest.approx(low[0], abs=5)
    assert region["y"] == pytest.approx(low[1], abs=5)
    assert region["y"] + region["height"] == pytest.approx(high[1], abs=5)
    click_pixel(page, 63, 42)
    page.keyboard.press("Escape")
    page.keyboard.press("c")
    settle(page)
    # A is left on the screen: where y is large.
    assert shown_colour(page, 45, 115).max() > 60
    assert shown_colour(page, 45, 20).max() < 40
    # Keys move in directions of the screen.
    page.evaluate("levkasViewer.stage.look(75, 65, 12)")
    page.keyboard.press("ArrowRight")
    settle(page)
    x, y = page.evaluate("levkasViewer.stage.left.centre")
    assert x == pytest.approx(75, abs=0.5) and y < 60
    page.wait_for_function("() => location.hash.includes('turn=90')")
    again = open_object(browser, page.url)
    assert again.evaluate("levkasViewer.stage.degrees") == 90
    page.keyboard.press("Shift+T")
    assert page.evaluate("levkasViewer.stage.degrees") == 0


@pytest.mark.slow
def test_zoom_has_buttons_and_a_figure_and_the_wheel(browser, address):
    page = open_object(browser, address("file"))
    settle(page)
    figure = page.locator(".percent")

    def percent():
        pause(page, 700)
        return float(figure.inner_text().rstrip(" %"))

    assert percent() == pytest.approx(100 * page.evaluate("levkasViewer.stage.left.scale"), abs=1)
    before = percent()
    page.get_by_role("button", name="Zoom in").click()
    assert percent() == pytest.approx(1.4 * before, rel=0.02)
    page.locator("#stage").hover()
    page.mouse.wheel(0, -200)
    assert percent() > 1.5 * before
    page.keyboard.press("0")
    assert percent() == 100
    page.get_by_role("button", name="Fit").click()
    assert percent() == pytest.approx(before, abs=1)


# --- touch ----------------------------------------------------------------------------------------


def swipe(page, start, end, fingers=1, apart=0):
    """Move one finger, or two side by side, over the screen."""
    session = page.context.new_cdp_session(page)

    def points(t):
        x, y = (a + t * (b - a) for a, b in zip(start, end, strict=True))
        return [{"x": x + i * (60 + apart * t), "y": y, "id": i} for i in range(fingers)]

    send = session.send
    send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": points(0)})
    for i in range(1, 9):
        send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": points(i / 8)})
        pause(page, 30)
    send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    pause(page, 500)
    session.detach()


@pytest.mark.slow
def test_a_thumb_scrolls_past_the_painting_and_two_fingers_move_it(browser, address):
    page = open_object(browser, address("file"), width=390, height=844, has_touch=True, is_mobile=True)  # fmt: skip
    settle(page)
    box = page.locator("#stage").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    up = middle[0], middle[1] - 160
    view = "[...levkasViewer.stage.left.centre, levkasViewer.stage.left.scale]"
    before = page.evaluate(view)
    swipe(page, middle, up)
    assert page.evaluate("scrollY") > 60
    np.testing.assert_allclose(page.evaluate(view), before, rtol=1e-3)
    page.evaluate("scrollTo(0, 0)")
    pause(page, 200)
    swipe(page, (middle[0] - 60, middle[1]), (middle[0] - 110, middle[1]), 2, apart=100)
    assert page.evaluate("scrollY") < 20
    assert page.evaluate(view)[2] > 1.3 * before[2]
    before = page.evaluate(view)
    drag = page.get_by_role("button", name="Drag with one finger")
    drag.click()
    assert drag.get_attribute("aria-pressed") == "true"
    page.evaluate("scrollTo(0, 0)")
    swipe(page, middle, up)
    assert page.evaluate("scrollY") < 20
    assert abs(page.evaluate(view)[1] - before[1]) > 5
