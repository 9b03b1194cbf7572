"""What a person meets in the first seconds: no ghosts, short words, a spectrum over the picture on a phone, a short report."""

import pytest

from levkas.pages.page import LayerReport

from .serving import pause
from .test_report import png, written

PHONE = {"width": 390, "height": 844, "has_touch": True, "is_mobile": True}


def open_second(browser, address, **options):
    page = browser.open(address("file", "viewer/objects/icon2/index.html"), **options)
    page.wait_for_function("() => levkasViewer.stage.left.settled")
    return page


@pytest.mark.slow
def test_the_pointer_of_another_pane_shows_where_there_is_another_pane_only(browser, address):
    page = open_second(browser, address)
    shown = "[...document.querySelectorAll('.pointer')].filter(one => one.checkVisibility()).length"
    for mode, count in (("", 0), ("c", 0), ("s", 1)):
        if mode:
            page.keyboard.press(mode)
            pause(page, 300)
        page.mouse.move(300, 400)
        page.mouse.move(310, 410)
        pause(page, 60)
        assert page.evaluate(shown) == count, mode


def test_a_pinned_spectrum_lies_over_the_picture_of_a_phone_and_two_fingers_zoom_at_once(
    browser, address
):
    page = open_second(browser, address, **PHONE)
    before = page.evaluate("levkasViewer.stage.left.scale")
    touch = page.context.new_cdp_session(page)
    for kind, by in [
        ("touchStart", 0),
        *(("touchMove", 8 * k) for k in range(1, 9)),
        ("touchEnd", 0),
    ]:
        points = [{"x": 180 - by, "y": 450, "id": 0}, {"x": 220 + by, "y": 450, "id": 1}]
        touch.send(
            "Input.dispatchTouchEvent",
            {"type": kind, "touchPoints": points if kind != "touchEnd" else []},
        )
        pause(page, 15)
    page.wait_for_function(f"() => levkasViewer.stage.left.scale > 1.5 * {before}")
    page.evaluate("levkasViewer.state.pin.value = [20, 20]")
    page.wait_for_selector(".spectrum-part svg")
    box = page.locator(".spectrum-part").bounding_box()
    assert box["y"] > 400 and box["y"] + box["height"] == pytest.approx(844, abs=1)
    page.get_by_role("button", name="Close the spectrum").click()
    assert page.evaluate("levkasViewer.state.pin.value") is None
    assert (
        page.evaluate("getComputedStyle(document.querySelector('.spectrum-part')).position")
        == "static"
    )


def test_spectra_of_places_begin_with_the_layer_that_is_shown(browser, address):
    page = open_second(browser, address)
    chosen = page.get_by_label("Layer whose spectra are compared")
    assert chosen.input_value() == "vis"
    page.keyboard.press("2")
    assert chosen.input_value() == "rgb"
    chosen.select_option("vis")
    page.keyboard.press("2")
    assert chosen.input_value() == "vis"


def test_the_picture_takes_the_whole_screen(browser, address):
    page = open_second(browser, address)
    page.keyboard.press("w")
    page.wait_for_function("() => document.fullscreenElement?.classList.contains('wall')")
    page.keyboard.press("w")
    page.wait_for_function("() => document.fullscreenElement === null")


def test_a_report_takes_three_screens_of_a_phone_and_links_unfold(browser, tmp_path):
    reasons = ["It is another painting."] * 9
    layers = [
        LayerReport("vis", ["550 nm"], "reflectance", "reference", "levkas", preview="vis.png"),
        LayerReport("nir", ["850 nm"], "reflectance", "refuse", "levkas", reasons=reasons, recorded="rec.png"),
        *(LayerReport(f"c{n}", ["R"], "counts", "warn", "levkas", reasons=reasons, preview="vis.png") for n in range(3)),
    ]  # fmt: skip
    for name in ("vis.png", "rec.png"):
        (tmp_path / name).write_bytes(png(120))
    page = browser.open(written(tmp_path, layers).as_uri(), **PHONE)
    assert page.evaluate("document.documentElement.scrollHeight") <= 3 * 844
    page.evaluate("location.hash = 'evidence'")
    page.wait_for_selector("#evidence table")
    wide = browser.open((tmp_path / "report.html").as_uri())
    figures = wide.locator("#layer-nir .recorded figcaption")
    assert figures.all_inner_texts() == ["nir, as it was recorded", "vis, the reference"]


def test_a_picture_that_loads_says_so_and_no_longer(browser, address):
    page, held, pattern = browser.page(), [], "**/layers/0/colour/**"
    holding = [True]
    page.route(pattern, lambda r: held.append(r) if holding[0] else r.continue_())
    where = address("http", "viewer/objects/icon2/index.html")
    browser.allow(where)
    page.goto(where, wait_until="domcontentloaded")
    said = page.locator(".cell-a .loading")
    said.wait_for(state="visible")
    assert said.inner_text() == "Loading the picture …" and held
    holding[0] = False
    for route in held:
        route.continue_()
    said.wait_for(state="hidden")
    assert page.evaluate("levkasViewer.stage.left.settled")
