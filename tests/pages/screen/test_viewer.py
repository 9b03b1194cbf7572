"""The published viewer in a real browser, from file://; over http as `slow`."""

import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import levkas
from levkas.calibration.error_sources import ErrorSource
from levkas.core.cube import Flag
from levkas.core.flags import MARKS
from levkas.database.pixel_frames import find_map
from levkas.database.tiff_pages import open_pages
from levkas.publish.viewer.pictures import shown_band
from levkas.registration.record import Sigma

from .database import CAMERAS, write_database, write_hostile_database
from .serving import pause

SETTLED = (
    "() => window.levkasViewer?.stage.left.viewer.world.getItemCount() > 0"
    " && levkasViewer.stage.settled"
)
PHONE = {"width": 390, "height": 844, "has_touch": True, "is_mobile": True}
FLIGHTS = ["file", pytest.param("http", marks=pytest.mark.slow)]


def open_object(browser, url, **options):
    page = browser.open(url, **options)
    page.wait_for_function(SETTLED)
    return page


def settle(page):
    page.wait_for_function(SETTLED)
    pause(page, 300)


def page_of(page, x, y):
    """Where the middle of a pixel of the grid is on the screen."""
    return page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})")


def click_pixel(page, x, y):
    page.mouse.click(*page_of(page, x, y))
    page.wait_for_selector(f'.place[data-pixel="{x},{y}"]')


def drag(page, start, end):
    first, last = page_of(page, *start), page_of(page, *end)
    page.mouse.move(*first)
    page.mouse.down()
    page.mouse.move(*last, steps=3)
    page.mouse.up()


def shown_colour(page, x, y):
    """Colour of the screen at the middle of a pixel of the grid."""
    left, top = page_of(page, x, y)
    clip = {"x": round(left) - 1, "y": round(top) - 1, "width": 3, "height": 3}
    image = Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")
    return np.asarray(image, int)[1, 1]


def rendered(viewer, camera, x, y):
    return open_pages(viewer / f"objects/icon1/icon1_{camera}.tif").read_render()[y, x].astype(int)


def rows_of(page, name="Save as CSV", part="#kept"):
    """The rows of a file that a button saves."""
    with page.expect_download() as download:
        page.locator(part).get_by_role("button", name=name, exact=True).click()
    with Path(download.value.path()).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("how", FLIGHTS)
def test_the_contact_sheet_leads_to_every_object_and_back(browser, address, how):
    page = browser.open(address(how, "index.html"))
    assert page.locator(".card .title").all_inner_texts() == ["First icon", "Second icon"]
    page.wait_for_function(
        "() => [...document.images].every(i => i.complete && i.naturalWidth > 0)"
    )
    page.locator("#search").fill("SECOND")
    assert page.locator(".card:visible .title").all_inner_texts() == ["Second icon"]
    page.locator("#search").fill("nir")
    assert page.locator(".card:visible").count() == 2
    page.locator("#verdict").select_option("refuse")
    assert page.locator(".card:visible .title").all_inner_texts() == ["Second icon"]
    page.locator("#search").fill("no such object")
    page.locator("#clear").click()
    page.locator(".card a").nth(1).click()
    page.wait_for_function(SETTLED)
    assert page.locator("h1").inner_text() == "Second icon"
    page.evaluate("location.hash = '#a=vis/flags&b=vis/colour&mode=curtain&pin=30,40'")
    page.wait_for_function("() => location.hash.includes('scale')")
    page.keyboard.press("[")  # how one looks is carried over, where is not
    page.wait_for_url("**/icon1/index.html*")
    page.wait_for_function("() => levkasViewer.state.a.value.picture.key === 'flags'")
    assert page.evaluate("levkasViewer.stage.mode.value") == "curtain"
    assert page.evaluate("levkasViewer.state.pin.value") is None
    page.locator("a.back").click()
    page.wait_for_selector(".cards")


@pytest.mark.parametrize("how", FLIGHTS)
def test_a_click_reads_the_very_numbers_of_the_files_and_the_native_pixel_of_every_camera(
    browser, address, viewer, how
):
    page = open_object(browser, address(how))
    for x, y in ((63, 42), (64, 64), (147, 127)):
        page.evaluate(f"levkasViewer.stage.look({x}, {y}, 8)")
        click_pixel(page, x, y)
        for camera in CAMERAS:
            for kind, suffix in (("value", ""), ("sigma", ".sigma")):
                cells = page.locator(f'.numbers tbody[data-layer="{camera}"] [data-{kind}]')
                shown = cells.evaluate_all(f"all => all.map(c => c.dataset.{kind})")
                pages = open_pages(viewer / f"objects/icon1/icon1_{camera}{suffix}.tif")
                np.testing.assert_array_equal(
                    np.array(shown, np.float32), pages.read(y, y + 1)[0, x]
                )
            told = page.locator(f'.native[data-layer="{camera}"]')
            if told.count():
                native = [float(told.get_attribute(f"data-{axis}")) for axis in "xy"]
                truth = find_map(viewer, "icon1", "grid", camera)(np.array([[x, y]], float))[0]
                assert np.hypot(*(native - truth)) < 0.5, camera
        page.keyboard.press("Escape")
    assert page.locator(".native[data-layer]").count() == 0, "nothing is read any more"


def test_a_place_between_pixels_is_mapped_to_a_hundredth_of_a_pixel(browser, address, viewer):
    page = open_object(browser, address("file"))
    points = np.random.default_rng(2).uniform([4, 1], [148, 128], (30, 2))
    for camera in ("rgb", "nir"):
        found = page.evaluate(
            """async ([camera, points]) => {
              const one = levkasViewer.readout.sources.find(s => s.layer.name === camera);
              return Promise.all(points.map(async p => await one.lattice.find(p, 1) ?? [NaN, NaN]));
            }""",
            [camera, points.tolist()],
        )
        truth = find_map(viewer, "icon1", "grid", camera)(points)
        known = np.isfinite(truth[:, 0])
        assert known.sum() > 15
        np.testing.assert_allclose(np.array(found, float)[known], truth[known], atol=0.02)


def test_values_that_are_not_to_be_trusted_are_struck_and_no_line_leads_through_them(
    browser, address
):
    page = open_object(browser, address("file", fragment="#a=vis/flags"))
    page.evaluate("levkasViewer.stage.look(85, 70, 6)")
    settle(page)
    assert np.abs(shown_colour(page, 103, 103) - MARKS[Flag.VEILED].colour).max() < 12
    page.locator(".numbers-fold summary").click()
    row = page.locator('.numbers tbody[data-layer="vis"] tr').nth(1)
    struck = "e => getComputedStyle(e).textDecorationLine"
    for (x, y), line in {(105, 103): "line-through", (113, 103): "none"}.items():  # veiled, defect
        click_pixel(page, x, y)
        assert row.locator(".n").first.evaluate(struck) == line
        assert row.locator(".swatch").count() == 1
    page.evaluate("levkasViewer.readout.record.flags.pop()")  # what no table names
    click_pixel(page, 105, 103)
    assert row.locator(".n").first.evaluate(struck) == "line-through"
    click_pixel(page, 65, 41)  # saturated in one band of each camera
    doubt = page.locator("#spectrum .doubt")
    assert doubt.count() == page.locator(".doubts").count() == 3
    lines = page.locator("#spectrum polyline.line").evaluate_all("all => all.map(l => l.points.length)")  # fmt: skip
    assert sorted(lines) == [1, 1, 1, 1, 7]


@pytest.mark.parametrize("how", FLIGHTS)
def test_the_picture_and_every_comparison_show_what_is_in_the_files(browser, address, viewer, how):
    page = open_object(browser, address(how, fragment="#a=vis/colour&b=vis/flags"))
    for scale in (3.5, 12):
        page.evaluate(f"levkasViewer.stage.look(75, 65, {scale})")
        settle(page)
        for x, y in ((75, 65), (65, 75), (85, 55)):
            assert np.abs(shown_colour(page, x, y) - rendered(viewer, "vis", x, y)).max() < 40
    page.keyboard.press("f")
    page.keyboard.press("c")
    settle(page)
    left, right = (30, 90), (120, 90)
    assert np.abs(shown_colour(page, *left) - rendered(viewer, "vis", *left)).max() < 40
    assert shown_colour(page, *right).max() < 40  # no flag: nearly black
    line = page.locator(".curtain")
    line.focus()
    page.keyboard.press("ArrowRight")
    assert line.get_attribute("aria-valuenow") == "52"
    page.keyboard.press("End")
    pause(page, 300)
    assert shown_colour(page, *right).max() > 60
    page.keyboard.press("Shift+C")
    settle(page)
    assert line.get_attribute("aria-orientation") == "vertical"
    page.evaluate("levkasViewer.stage.curtain.move(0.5)")
    pause(page, 200)
    assert shown_colour(page, 45, 95).max() < 40 < shown_colour(page, 45, 35).max()
    page.evaluate("location.hash = '#a=vis/colour&b=rgb/colour&mode=opacity&opacity=0.25'")
    page.wait_for_function("() => levkasViewer.stage.opacity.value === 0.25")
    settle(page)
    a, b = (rendered(viewer, camera, 85, 55) for camera in ("vis", "rgb"))
    assert np.abs(shown_colour(page, 85, 55) - (0.25 * b + 0.75 * a)).max() < 14
    page.evaluate("location.hash = '#a=vis/colour&b=rgb/colour&mode=difference&amplify=1'")
    page.wait_for_function("() => levkasViewer.stage.mode.value === 'difference'")
    settle(page)
    assert np.abs(shown_colour(page, 85, 55) - np.abs(a - b)).max() < 40
    page.evaluate("location.hash = '#a=vis/colour&brightness=1.5'")
    page.wait_for_function("() => levkasViewer.stage.mode.value === 'single'")
    settle(page)
    assert np.abs(shown_colour(page, 85, 55) - np.minimum(1.5 * a, 255)).max() < 14


@pytest.mark.parametrize("turn", [0, pytest.param(90, marks=pytest.mark.exhaustive)])
def test_a_difference_of_nothing_is_black_to_its_edge(browser, address, turn):
    fragment = f"#a=vis/band-3&b=vis/band-3&mode=difference&amplify=16&turn={turn}"
    page = open_object(browser, address("file", fragment=fragment))
    settle(page)
    image = Image.open(io.BytesIO(page.screenshot(clip=page.locator("#stage").bounding_box())))
    assert np.asarray(image.convert("RGB"), int)[3:-3, 3:-3].max() <= 3


TURNS = """async () => {
  const seen = new Set(), from = performance.now();
  while (performance.now() - from < 700) {
    seen.add(levkasViewer.stage.inTurn.value);
    await new Promise(requestAnimationFrame);
  }
  return seen.size;
}"""


@pytest.mark.slow
def test_flicker_is_held_by_a_key_waits_after_a_link_and_never_turns_where_motion_is_unwanted(
    browser, address
):
    url = address("file", fragment="#a=vis/colour&b=nir/band-0&mode=flicker&rate=8")
    page = open_object(browser, url)
    settle(page)
    assert page.evaluate(TURNS) == 1
    page.get_by_role("button", name="Start", exact=True).click()
    assert page.evaluate(TURNS) == 2
    page.keyboard.press("k")
    assert page.evaluate("levkasViewer.stage.mode.value") == "single"
    page.keyboard.down(" ")
    assert page.evaluate(TURNS) == 2
    page.keyboard.up(" ")
    assert page.evaluate("levkasViewer.stage.flicker.running") is False
    calm = open_object(browser, url, reduced_motion="reduce")
    settle(calm)
    assert calm.evaluate(TURNS) == 1
    before = calm.evaluate("levkasViewer.stage.inTurn.value")
    calm.get_by_role("button", name="Show the other").click()
    assert calm.evaluate("levkasViewer.stage.inTurn.value") != before


@pytest.mark.slow
def test_four_pictures_are_linked_and_the_pointer_is_in_all(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("q")
    settle(page)
    boxes = [box.bounding_box() for box in page.locator(".cell:visible").all()]
    assert len({round(b["x"]) for b in boxes}) == len({round(b["y"]) for b in boxes}) == 2
    page.locator(".cell-d .pane").hover()
    page.mouse.wheel(0, -300)
    pause(page, 900)
    views = page.evaluate("levkasViewer.stage.cells.map(({pane}) => [...pane.centre, pane.scale])")
    np.testing.assert_allclose(views, [views[0]] * 4, rtol=1e-3, atol=0.1)
    x, y = boxes[0]["x"] + 60, boxes[0]["y"] + 70
    page.mouse.move(x, y)
    pause(page, 100)
    places = page.evaluate(
        """() => levkasViewer.stage.cells.slice(1).map(({pane, pointer}) => {
          const box = pointer.getBoundingClientRect();
          return pane.pixelAt(box.x + box.width / 2, box.y + box.height / 2);
        })"""
    )
    pointed = page.evaluate(f"levkasViewer.stage.left.pixelAt({x}, {y})")
    np.testing.assert_allclose(places, [pointed] * 3, atol=0.3)
    page.get_by_role("button", name="Show nir in C").click()
    page.wait_for_function("() => location.hash.includes('c=nir')")


@pytest.mark.slow
def test_three_chosen_bands_are_red_green_and_blue(browser, viewer, address):
    page = open_object(browser, address("file"))
    page.get_by_label("Picture in A").select_option("mix")
    for ink, band in zip(("red", "green", "blue"), (6, 3, 0), strict=True):
        page.get_by_label(f"Band shown as {ink} in A").select_option(str(band))
    page.wait_for_function("() => levkasViewer.state.a.value.picture.key === 'mix-6-3-0'")
    settle(page)
    pages = open_pages(viewer / "objects/icon1/icon1_vis.tif")
    shown = [shown_band(pages.read_page(band))[0] for band in (6, 3, 0)]
    for x, y in ((25, 25), (95, 65)):
        expected = [int(image[y, x]) for image in shown]
        assert np.abs(shown_colour(page, x, y) - expected).max() < 40
    page.wait_for_function("() => location.hash.includes('mix-6-3-0')")


@pytest.mark.slow
def test_a_turn_takes_pictures_marks_curtain_and_keys_along(browser, viewer, address):
    fragment = "#a=vis/colour&b=vis/flags&kept=place;30 40;Here&kept=rectangle;20 20 60 40;R"
    page = open_object(browser, address("file", fragment=fragment))
    page.keyboard.press("t")
    settle(page)
    place, beside = page_of(page, 30, 40), page_of(page, 40, 40)
    assert beside[1] > place[1] + 5 and abs(beside[0] - place[0]) < 0.5, "right has become down"
    assert np.abs(shown_colour(page, 95, 65) - rendered(viewer, "vis", 95, 65)).max() < 40
    pin = page.locator(".cell-a .kept-pin").bounding_box()
    middle = pin["x"] + pin["width"] / 2, pin["y"] + pin["height"] / 2
    np.testing.assert_allclose(middle, place, atol=1.5)
    shape = page.locator(".cell-a .shape-line").first.bounding_box()
    assert [shape["x"], shape["y"]] == pytest.approx(page_of(page, 19.5, 40.5), abs=5)
    page.keyboard.press("c")
    settle(page)
    # A is left on the screen: where y is large.
    assert shown_colour(page, 45, 115).max() > 60 > 40 > shown_colour(page, 45, 10).max()
    page.evaluate("levkasViewer.stage.look(75, 65, 12)")
    page.keyboard.press("ArrowRight")
    settle(page)
    x, y = page.evaluate("levkasViewer.stage.left.centre")
    assert x == pytest.approx(75, abs=0.5) and y < 60


@pytest.mark.slow
def test_on_a_phone_one_finger_scrolls_two_zoom_and_a_spectrum_lies_over_the_picture(
    browser, address
):
    page = open_object(browser, address("file"), **PHONE)
    box = page.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def swipe(*fingers):
        for t in range(10):
            kind = "touchStart" if t == 0 else "touchMove" if t < 9 else "touchEnd"
            points = [{"x": a + t * dx, "y": b + t * dy, "id": i}
                      for i, (a, b, dx, dy) in enumerate(fingers)]  # fmt: skip
            touch.send(
                "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points if t < 9 else []}
            )
            pause(page, 20)
        pause(page, 400)

    before = page.evaluate("levkasViewer.stage.left.scale")
    swipe((x, y, 0, -18))
    assert page.evaluate("scrollY") > 60
    assert page.evaluate("levkasViewer.stage.left.scale") == pytest.approx(before, rel=1e-3)
    page.evaluate("scrollTo(0, 0)")
    swipe((x - 30, y, -8, 0), (x + 30, y, 8, 0))
    assert page.evaluate("levkasViewer.stage.left.scale") > 1.3 * before
    page.evaluate("levkasViewer.state.pin.value = [20, 20]")
    page.wait_for_selector(".spectrum-part svg")
    pinned = page.locator(".spectrum-part").bounding_box()
    assert pinned["y"] + pinned["height"] == pytest.approx(844, abs=1)
    page.get_by_role("button", name="Close the spectrum").click()
    assert page.evaluate("levkasViewer.state.pin.value") is None


# --- what is kept, and how sure it is -------------------------------------------------------------

CORRELATION = [[0.02, 0.1, 0.02], [0.1, 1.0, 0.1], [0.02, 0.1, 0.02]]


def budget_of(labels):
    """A budget with a row of every kind."""

    def row(name, unit, size, common_to="camera", *, shared=True, zero=0.0):
        sizes = {label: size * (1 + k / 10) for k, label in enumerate(labels)}
        zeros = dict.fromkeys(labels, zero) if zero else {}
        return ErrorSource(name, unit, sizes, common_to, all_bands=shared, zero_at=zeros)

    return [
        row("photons", "reflectance", 0.5, "pixel", shared=False),
        row("white board", "relative", 0.01, "campaign"),
        row("lamp", "relative", 0.02, "line"),
        row("chart", "relative", 0.004, shared=False),
        row("stray light", "reflectance", 0.02, zero=0.3),
        row("black level", "reflectance", 0.001, shared=False),
        row("curve", "relative", 0.01, zero=0.9),
        row("wavelength", "nm", 1.5, shared=False),
        ErrorSource("linearity", "relative", {}, "camera", all_bands=True, basis="unknown"),
    ]


@pytest.fixture(scope="module")
def sure(add_viewer, tmp_path_factory):
    """Folder of a published database; errors of `vis` alone are recorded, and places little known."""
    folder = write_database(tmp_path_factory.mktemp("sure") / "database", {"icon1": "Icon"})
    of = {"camera": "vis", "setup": ""}
    rows = [row.to_dict() for row in budget_of(CAMERAS["vis"])]
    steps = [
        {"stage": "calibrate", **of, "uncertainty": rows},
        {"stage": "resample", **of, "noise_correlation": CORRELATION},
    ]
    place = folder / "objects/icon1"
    (place / "provenance.json").write_text(json.dumps({"steps": steps}), encoding="utf-8")
    register = place / "registration/vis.json"
    record = json.loads(register.read_text())
    for band in record["bands"].values():
        x, y = np.meshgrid([0.0, 160.0], [0.0, 120.0])
        band["sigma"] = Sigma(x[0], y[:, 0], 0.5 + 0.004 * x + 0.002 * y).to_dict()
    register.write_text(json.dumps(record), encoding="utf-8")
    return add_viewer(folder)


def test_places_rectangles_and_lengths_have_the_numbers_of_the_database(browser, sure):
    layer = levkas.open(sure)["icon1"]["vis"]
    url = (sure / "viewer/objects/icon1/index.html").as_uri()
    page = open_object(browser, f"{url}#a=vis/colour")
    click_pixel(page, 80, 60)
    page.keyboard.press("p")
    page.get_by_label("Name of place 1").fill('=azurite, "dark"')
    page.locator("#kept").get_by_role("button", name="Rectangle").click()
    drag(page, (20, 50), (33, 58))
    page.keyboard.press("g")
    for corner in ((0, 0), (149, 129)):  # flagged pixels in it; the keyboard alone
        page.evaluate(f"levkasViewer.state.pin.value = {list(corner)}")
        page.keyboard.press("p")
    page.keyboard.press("m")
    page.mouse.click(*page_of(page, 20, 100))
    page.mouse.click(*page_of(page, 60, 130 - 60))
    page.wait_for_function("() => document.querySelectorAll('.pins li').length === 4")
    page.wait_for_function("() => document.querySelectorAll('#kept svg .line').length === 3")
    kept = page.evaluate("levkasViewer.state.kept.value")
    assert [one["kind"] for one in kept] == ["place", "rectangle", "rectangle", "length"]
    length = float(np.hypot(*np.subtract(*kept[3]["points"]))) / 1.25
    told = page.locator(".pin-words").all_inner_texts()
    assert float(told[3].removesuffix(" mm")) == pytest.approx(length, rel=1e-3)
    assert length == pytest.approx(40, rel=0.02)
    band = page.evaluate("levkasViewer.record.layers.find(l => l.name === 'vis').reference_band")
    found = page.locator(".pin-words").evaluate_all("all => all.map(e => ({...e.dataset}))")
    rows = [row for row in rows_of(page) if row["layer"] == "vis"]
    assert {row["name"] for row in rows} == {'\'=azurite, "dark"', "Rectangle 1", "Rectangle 2"}
    count = len(CAMERAS["vis"])
    # Flagged pixels' neighbours have no noise in common with them.
    for k, rel in enumerate([3e-3, 3e-3, 2e-2]):
        points = np.round(kept[k]["points"]).astype(int)
        corners = [*points.min(0).tolist(), *points.max(0).tolist()]
        region, known = (
            layer.levkas.region(rectangle=corners),
            layer.levkas.uncertainty(rectangle=corners),
        )
        mine = rows[k * count : (k + 1) * count]
        assert float(found[k]["mean"]) == pytest.approx(float(region["mean"][band]), rel=1e-6)
        assert float(found[k]["u"]) == pytest.approx(float(known.u[band]), rel=rel)
        assert [float(r["u"]) for r in mine] == pytest.approx(known.u.values.tolist(), rel=rel)
        if k:
            assert [int(r["n"]) for r in mine] == region["n"].values.tolist()
            spreads = [float(r["spread"]) for r in mine]
            assert spreads == pytest.approx(region["std"].values.tolist(), rel=1e-5)
    cells = page.locator("tbody[data-layer=vis] td[data-expanded]")
    assert cells.count() in (0, count)
    page.wait_for_function("() => location.hash.split('kept=').length === 5")
    again = open_object(browser, page.url)
    again.wait_for_function("() => document.querySelectorAll('#kept svg .line').length === 3")
    same = again.locator(".pin-words").evaluate_all("all => all.map(e => ({...e.dataset}))")
    assert same == found and again.locator(".stage .cell-a .kept-pin").count() == 1
    again.keyboard.press("2")  # errors of another layer are not recorded
    again.wait_for_function("() => document.querySelector('.pin-words').dataset.u === ''")
    again.get_by_label("Remove Rectangle 1").click()
    assert again.locator(".pins li").count() == 3
    again.evaluate("location.hash = '#a=vis/colour&kept=place;30 40;Red lake&kept=place;999 1;far'")
    again.wait_for_function("() => levkasViewer.state.kept.value.length === 1")


@pytest.mark.slow
def test_a_drawing_is_given_up_and_a_link_holds_what_is_chosen(browser, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&b=rgb/colour"))
    page.keyboard.press("g")
    page.mouse.click(*page_of(page, 20, 20))
    page.keyboard.press("Escape")
    assert page.evaluate("levkasViewer.state.kept.value.length") == 0
    assert page.locator('#kept [aria-pressed="true"]').count() == 0
    page.keyboard.press("c")
    page.evaluate("levkasViewer.stage.curtain.move(0.25)")
    for name, value in (("Rate", 4), ("Amplify", 8)):
        page.locator("label.slider", has_text=name).locator("input").evaluate(
            f"e => {{ e.value = {value}; e.dispatchEvent(new Event('input')); }}"
        )
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy link").click()
    page.wait_for_function("() => document.getElementById('said').textContent !== ''")
    link = page.evaluate("navigator.clipboard.readText()")
    assert link == page.url
    again = open_object(browser, link)
    state = """() => [levkasViewer.stage.mode.value, levkasViewer.stage.curtain.fraction,
      levkasViewer.stage.flicker.rate, levkasViewer.stage.gain.value]"""
    assert again.evaluate(state) == ["curtain", 0.25, 4, 8]
    again.evaluate("location.hash = '#a=vis/colour'")  # of what it is silent: as on a fresh page
    again.wait_for_function("() => levkasViewer.stage.mode.value === 'single'")
    assert again.evaluate(state)[2:] == [2, 4]


# --- text from outside ----------------------------------------------------------------------------

EVIL = "window.evil=1"
TITLES = [
    f"</script><script>{EVIL}</script>",
    f"</title><script>{EVIL}</script>",
    f'"><img src=x onerror={EVIL}>',
    f"' onfocus='{EVIL}' autofocus='",
    f"<svg><animate onbegin={EVIL} attributeName=x dur=1s>",
    f'<iframe srcdoc="<script>parent.{EVIL}</script>">',
    "<base href=http://elsewhere.invalid/>",
    "<meta http-equiv=refresh content='0;url=http://elsewhere.invalid/'>",
    "<style>@import url(http://elsewhere.invalid/a.css);*{display:none}</style>",
    f"]]><!--><script>{EVIL}</script>",
    f"javascript:{EVIL}",
    "{{ 7 * 7 }}{% raw %}${7*7}",
    f"'];{EVIL};//",
    "line\u2028separator and right\u202eot tfel\u202c",
    "%2e%2e%2fetc%2fpasswd?query=1&b=2#fragment 100% %zz",
    '=HYPERLINK("http://elsewhere.invalid")',
    "__proto__",
]
STATE = """() => ({
  evil: window.evil ?? null,
  head: document.querySelector('h1').textContent,
  told: [...document.querySelectorAll('.picker-a option, .reasons')].map(e => e.textContent),
  foreign: document.querySelectorAll('iframe, object, embed, base, form[action], svg script, [onload], [onfocus]').length,
  links: [...document.querySelectorAll('a')].map(a => a.protocol),
})"""


@pytest.mark.slow
def test_hostile_titles_and_file_names_are_shown_and_do_nothing(
    browser, add_viewer, publish_with, tmp_path
):
    names = [t.replace("/", "∕")[:60].strip() for t in TITLES]
    folder = write_hostile_database(tmp_path / "database", TITLES, names)
    published = publish_with(folder, TITLES[0], TITLES[2])
    page = browser.open((published / "index.html").as_uri())
    assert sorted(page.locator(".card .title").all_text_contents()) == sorted(TITLES)
    links = page.evaluate("[...document.querySelectorAll('.card a')].map(a => a.href)")
    heads = []
    for link in links:
        page.goto(link, wait_until="domcontentloaded")
        state = page.evaluate(STATE)
        assert state["evil"] is None and state["foreign"] == 0, link
        assert state["told"].count(state["head"]) >= 2
        heads.append(state["head"])
    assert sorted(heads) == sorted(TITLES)
    page.goto(links[-1])
    page.evaluate("const s = document.createElement('script'); s.textContent = 'window.evil = 1'; document.head.append(s)")  # fmt: skip
    assert page.evaluate("window.evil ?? null") is None, "the page's policy forbids it"
    browser.errors.clear()  # the browser tells of that
    state = browser.open((published / "README.html").as_uri()).evaluate(STATE)
    assert state["evil"] is None and state["foreign"] == 0 and state["head"] == TITLES[0]
    assert set(state["links"]) <= {"file:", "https:"}


def test_pages_hold_no_inline_script_and_a_policy_forbids_one(viewer):
    for path in [viewer / "index.html", *viewer.glob("viewer/objects/*/index.html")]:
        text = path.read_text(encoding="utf-8")
        assert "Content-Security-Policy" in text and "default-src &#39;none&#39;" in text
        scripts = re.findall(r"<script\b([^>]*)>", text)
        assert all("src=" in s or 'type="application/json"' in s for s in scripts)
        assert not re.search(r"\son[a-z]+=|javascript:|\sstyle=", text)
