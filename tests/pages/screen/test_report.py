"""The report of an object in a real browser: in short first, pictures, evidence, details; nothing moves by itself."""

import base64
import io
from dataclasses import replace

import pytest
from PIL import Image

from levkas.pages.maps import Legend, ReportMap
from levkas.pages.page import LayerReport, render_page
from levkas.pages.radiometry import RadiometryRow
from levkas.pages.summary import summarise_layers

from .serving import pause

REFERENCE = LayerReport("vis", ["550 nm"], "reflectance", "reference", "levkas", preview="vis.png")
COLOUR = LayerReport(
    "rgb", ["R", "G", "B"], "reflectance", "accept", "levkas", error="0.060 px = 0.073 mm over 96 %",
    error_px=0.06, checked=0.96, ssim="0.918", preview="rgb.png", links=[("layer, TIFF", "o rgb.tif")],
)  # fmt: skip
XRAY = LayerReport(
    "xray", ["grey"], "counts", "warn", "levkas", by_hand="aligned with 4 pairs by hand",
    error_px=0.25, checked=0.8, reasons=["Half of it is not confirmed."], next_step="Look at it.",
    preview="xray.png",
)  # fmt: skip
LOST = LayerReport(
    "nir", ["850 nm"], "reflectance", "refuse", "levkas", reasons=["It is another painting."],
    next_step="Run `levkas inspect CAMPAIGN`.",
)  # fmt: skip
ROWS = [
    RadiometryRow("vis", "0.008", "33", "6 stops", "0.6 %", "0.3 px",
                  glare_share=0.006, noise_median=0.008),
    RadiometryRow("rgb", "0.002", "50", "6 stops", "2 %", "0.5 px",
                  ("The scene goes beyond the sensor: 2 % saturates in R. Move the lamps.",),
                  glare_share=0.02, noise_median=0.002),
]  # fmt: skip


def png(colour, size=(90, 120)):
    target = io.BytesIO()
    Image.new("RGB", size, colour).save(target, "PNG")
    return target.getvalue()


def written(folder, layers, rows=ROWS, **more):
    """Write a report with its pictures: its path."""
    for number, name in enumerate(("vis", "rgb", "xray")):
        (folder / f"{name}.png").write_bytes(png((60 + 60 * number, 90, 40)))
    page = dict(
        viewer="",
        title="An icon", facts=["Egg tempera"], reference="vis:550 nm", layers=layers, mm_per_px="1.212",
        views=[{"name": one.name, "src": one.preview} for one in layers if one.preview], radiometry=rows,
        short=summarise_layers(layers, rows, 1.212), links=[("museum facts", "object.toml")], **more,
    )  # fmt: skip
    path = folder / "report.html"
    path.write_text(render_page("report.html", page=page), encoding="utf-8")
    return path


def map_of(title):
    legend = Legend(least="0", most="0.1 px or more")
    if title == "Flags":
        legend = Legend((("no flag", (24, 22, 19)), ("saturated", (230, 80, 80))))
    source = "data:image/png;base64," + base64.b64encode(png((200, 90, 40))).decode()
    return ReportMap(title, source, legend)


MAPS = [map_of(title) for title in ("Error of the registration", "Sigma", "Flags")]


# --- in short -------------------------------------------------------------------------------------


def test_in_short_names_the_worst_what_was_left_out_and_what_is_to_be_done():
    lines = summarise_layers([REFERENCE, COLOUR], ROWS, 1.212)
    assert [mark for mark, _ in lines] == ["ok", "warn", "ok", "next"]
    assert "0.060 px = 0.073 mm" in lines[0][1] and "96 %" in lines[0][1]
    marks, told = zip(
        *summarise_layers([REFERENCE, COLOUR, XRAY, LOST], [], None, ["uv"]), strict=True
    )
    assert "0.250 px" in told[0] and "xray" in told[0]
    assert marks.count("refuse") == 2 and marks[-1] == "next"


def test_of_a_sound_object_or_a_camera_alone_nothing_has_to_be_done():
    for layers in ([REFERENCE, replace(COLOUR, checked=None)], [REFERENCE]):
        assert [mark for mark, _ in summarise_layers(layers, [], None)] == ["ok", "next"]


def test_an_object_of_which_all_was_refused_has_no_empty_table(tmp_path):
    text = written(tmp_path, [], []).read_text()
    assert 'id="evidence"' not in text and 'id="short"' in text


# --- in the browser -------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1440, 390])
def test_short_first_then_pictures_then_evidence_then_details(browser, tmp_path, width):
    layers = [
        replace(one, maps=MAPS) if one.preview else one for one in (REFERENCE, COLOUR, XRAY, LOST)
    ]
    path = written(tmp_path, layers)
    page = browser.open(path.as_uri(), width=width, height=900)
    tops = [
        page.locator(name).first.bounding_box()["y"]
        for name in (
            "nav.contents",
            "#short",
            "#compare",
            "#evidence",
            "#radiometry",
            "details.layer",
        )
    ]
    assert tops == sorted(tops)
    if width == 1440:
        assert tops[-1] < 4 * 900  # at most four screens before the details
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("nav.contents a[href='#short']").count() == 1
    for href in page.eval_on_selector_all(
        "nav.contents a[href^='#']", "a => a.map(x => x.getAttribute('href'))"
    ):
        assert page.locator(href).count() == 1
    assert page.locator(".maprow figure").count() == 9
    boxes = page.eval_on_selector_all(".badge", "b => b.map(x => [x.scrollWidth, x.clientWidth])")
    assert all(inner <= outer for inner, outer in boxes)


@pytest.mark.slow
def test_nothing_flickers_by_itself_and_reduced_motion_stops_all_of_it(browser, tmp_path):
    path = written(tmp_path, [REFERENCE, COLOUR])
    for motion, moves in (("no-preference", True), ("reduce", False)):
        page = browser.open(path.as_uri(), reduced_motion=motion)
        state = "document.getElementById('over').style.visibility"
        seen = []
        page.locator("[data-mode=flicker]").click()
        for _ in range(12):
            seen.append(page.evaluate(state))
            pause(page, 100)
        assert (len(set(seen)) > 1) is moves
        if not moves:
            page.locator("[data-mode=flicker]").click()
            assert page.evaluate(state) != seen[-1]
            assert page.locator("#now").inner_text() == "Now: rgb"


def test_the_curtain_can_be_moved_where_the_picture_is_enlarged_and_the_picture_stays_in_view(
    browser, tmp_path
):
    page = browser.open(written(tmp_path, [REFERENCE, COLOUR]).as_uri())
    page.locator("#under").evaluate("image => image.decode()")
    page.locator("#zoom").fill("4")
    box = page.locator("#stage").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1])
    page.mouse.up()
    line = page.locator("#divider").bounding_box()
    assert line["x"] == pytest.approx(middle[0] + 60, abs=2)
    for dx in (2000, -4000):  # far beyond either side
        page.mouse.move(box["x"] + 10, middle[1])
        page.mouse.down()
        page.mouse.move(box["x"] + 10 + dx, middle[1])
        page.mouse.up()
        shown = page.locator("#under").bounding_box()
        assert shown["x"] <= box["x"] + 1
        assert shown["x"] + shown["width"] >= box["x"] + box["width"] - 1


def test_keys_compare_swap_zoom_and_flicker(browser, tmp_path):
    page = browser.open(written(tmp_path, [REFERENCE, COLOUR]).as_uri())
    page.locator("#under").evaluate("image => image.decode()")
    now = page.locator("#now")
    first = now.inner_text()
    page.keyboard.press("d")
    assert now.inner_text() != first
    page.keyboard.press("d")
    page.keyboard.press("x")
    assert now.inner_text().index("rgb") < now.inner_text().index("vis")
    page.keyboard.press("+")
    page.keyboard.press("+")
    assert page.locator("#times").inner_text() in ("× 2.3", "× 2.2")
    page.keyboard.press("f")
    assert page.locator("#times").inner_text() == "× 1"
    before = now.inner_text()
    page.keyboard.down(" ")
    page.wait_for_function(
        "(text) => document.querySelector('#now').textContent !== text", arg=before
    )
    page.keyboard.up(" ")
    assert page.locator("#keys kbd").nth(1).is_hidden()
    page.keyboard.press("?")
    assert page.locator("#keys kbd").nth(1).is_visible()


def test_details_open_where_something_is_to_be_checked_and_where_a_link_leads(browser, tmp_path):
    page = browser.open(written(tmp_path, [REFERENCE, COLOUR, XRAY, LOST]).as_uri())
    opened = "names => names.map(n => document.getElementById('layer-' + n).open)"
    assert page.evaluate(opened, ["vis", "rgb", "xray", "nir"]) == [False, False, True, True]
    page.locator("nav.contents a", has_text="rgb").click()
    page.wait_for_function("document.getElementById('layer-rgb').open")
    assert page.locator("#layer-rgb a").first.get_attribute("href") == "o%20rgb.tif"
    assert page.locator("#short code").first.inner_text() == "levkas inspect CAMPAIGN"


def test_a_report_takes_three_screens_of_a_phone_and_a_thumb_can_scroll_past_the_picture(
    browser, tmp_path
):
    many = [replace(XRAY, name=f"c{n}", reasons=["It is another painting."] * 9) for n in range(3)]
    path = written(tmp_path, [REFERENCE, COLOUR, *many])
    page = browser.open(path.as_uri(), width=390, height=844, has_touch=True, is_mobile=True)
    assert page.evaluate("document.documentElement.scrollHeight") <= 3 * 844
    assert page.locator("#evidence thead").is_hidden()
    assert page.locator("#stage").evaluate("s => getComputedStyle(s).touchAction") == "pan-y"
    page.evaluate("location.hash = 'evidence'")
    page.wait_for_selector("#evidence table")


def test_hostile_names_and_reasons_stay_text(browser, tmp_path):
    evil = "</script><img src=x onerror=alert(1)>"
    layer = replace(
        COLOUR, name=evil, reasons=[evil], next_step=evil, decision="warn", links=[(evil, evil)]
    )
    page = browser.open(written(tmp_path, [REFERENCE, layer]).as_uri())
    assert page.locator("img[src=x]").count() == 0 and evil in page.locator("#short").inner_text()
