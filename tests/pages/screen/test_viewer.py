import csv
import io
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from PIL import Image

import levkas
from levkas.core.cube import Flag
from levkas.core.flags import MARKS
from levkas.database.pixel_frames import find_map
from levkas.database.tiff_pages import open_pages
from levkas.publish.viewer.objects import LEFT_OUT
from levkas.publish.viewer.pictures import shown_band

from .database import CAMERAS
from .serving import pause

SETTLED = (
    "() => window.levkasViewer?.stage.left.viewer.world.getItemCount() > 0"
    " && levkasViewer.stage.settled"
)
FLIGHTS = ["file", pytest.param("http", marks=pytest.mark.slow)]


def open_object(browser, url, **options):
    page = browser.open(url, **options)
    page.wait_for_function(SETTLED)
    return page


def click_pixel(page, x, y):
    """Click the middle of a pixel of the grid."""
    where = page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})")
    page.mouse.click(*where)
    page.wait_for_selector(f'.place[data-pixel="{x},{y}"]')


def shown_colour(page, x, y):
    """Colour of the screen at the middle of a pixel of the grid."""
    where = page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})")
    clip = {"x": round(where[0]) - 1, "y": round(where[1]) - 1, "width": 3, "height": 3}
    image = Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")
    return np.asarray(image, int)[1, 1]


def rendered(viewer, camera, x, y):
    return open_pages(viewer / f"objects/icon1/icon1_{camera}.tif").read_render()[y, x].astype(int)


@pytest.mark.slow
@pytest.mark.parametrize("how", FLIGHTS)
def test_three_chosen_bands_are_red_green_and_blue(browser, viewer, address, how):
    page = open_object(browser, address(how))
    page.get_by_label("Picture in A").select_option("mix")
    for ink, band in zip(("red", "green", "blue"), (6, 3, 0), strict=True):
        page.get_by_label(f"Band shown as {ink} in A").select_option(str(band))
    page.wait_for_function("() => levkasViewer.state.a.value.picture.key === 'mix-6-3-0'")
    page.wait_for_function(SETTLED)
    pause(page, 400)
    pages = open_pages(viewer / "objects/icon1/icon1_vis.tif")
    shown = [shown_band(pages.read_page(band))[0] for band in (6, 3, 0)]
    for x, y in ((25, 25), (95, 65), (105, 75)):
        expected = [int(image[y, x]) for image in shown]
        assert np.abs(shown_colour(page, x, y) - expected).max() < 40
    assert "660 nm / 540 nm / 420 nm" in page.locator("#caption").inner_text()
    # The address holds it.
    page.wait_for_function("() => location.hash.includes('mix-6-3-0')")
    again = open_object(browser, page.url)
    assert again.get_by_label("Band shown as green in A").input_value() == "3"


@pytest.mark.parametrize("how", FLIGHTS)
def test_the_contact_sheet_leads_to_every_object_and_back(browser, address, how):
    page = browser.open(address(how, "index.html"))
    assert page.locator(".card .title").all_inner_texts() == ["First icon", "Second icon"]
    assert page.locator(".card .badge").all_inner_texts() == ["accepted", "1 of 3 refused"]
    page.wait_for_function(
        "() => [...document.images].every(i => i.complete && i.naturalWidth > 0)"
    )
    page.locator(".card a").nth(1).click()
    page.wait_for_function(SETTLED)
    assert page.locator("h1").inner_text() == "Second icon"
    page.keyboard.press("[")
    page.wait_for_url("**/icon1/index.html*")
    page.wait_for_function(SETTLED)
    page.locator("a.back").click()
    page.wait_for_selector(".cards")


def test_search_and_filters_leave_what_fits(browser, address):
    page = browser.open(address("file", "index.html"))
    page.locator("#search").fill("SECOND")
    assert page.locator("#count").inner_text() == "1 of 2 objects"
    assert page.locator(".card:visible .title").all_inner_texts() == ["Second icon"]
    page.locator("#search").fill("nir")
    assert page.locator(".card:visible").count() == 2
    page.locator("#verdict").select_option("refuse")
    assert page.locator(".card:visible .title").all_inner_texts() == ["Second icon"]
    page.locator("#search").fill("no such thing")
    page.locator("#clear").click()
    assert page.locator(".card:visible").count() == 2


@pytest.mark.parametrize("how", FLIGHTS)
def test_a_click_tells_the_native_pixel_of_every_camera(browser, address, viewer, how):
    page = open_object(browser, address(how))
    page.evaluate("levkasViewer.stage.look(75, 60, 6)")
    for x, y in ((70, 55), (82, 66)):
        click_pixel(page, x, y)
        for camera in ("vis", "rgb", "nir"):
            told = page.locator(f'.native[data-layer="{camera}"]')
            native = [float(told.get_attribute(f"data-{axis}")) for axis in "xy"]
            truth = find_map(viewer, "icon1", "grid", camera)(np.array([[x, y]], float))[0]
            assert np.hypot(*(native - truth)) < 0.5, camera
        page.keyboard.press("Escape")


def test_a_place_between_pixels_is_mapped_to_a_hundredth_of_a_pixel(browser, address, viewer):
    page = open_object(browser, address("file"))
    points = np.random.default_rng(2).uniform([4, 1], [148, 128], (30, 2))
    for camera in ("rgb", "nir"):
        found = page.evaluate(
            """async ([camera, points]) => {
              const {readout} = levkasViewer;
              const one = readout.sources.find(s => s.layer.name === camera);
              const told = [];
              for (const point of points) told.push(await one.lattice.find(point, 1));
              return told.map(p => p ?? [NaN, NaN]);
            }""",
            [camera, points.tolist()],
        )
        truth = find_map(viewer, "icon1", "grid", camera)(points)
        known = np.isfinite(truth[:, 0])
        assert known.sum() > 15
        np.testing.assert_allclose(np.array(found, float)[known], truth[known], atol=0.02)


@pytest.mark.parametrize("how", FLIGHTS)
def test_spectra_and_sigma_under_the_cursor_are_the_very_numbers_of_the_file(
    browser, address, viewer, how
):
    page = open_object(browser, address(how))
    for x, y in ((63, 42), (64, 64), (147, 127)):
        page.evaluate(f"levkasViewer.stage.look({x}, {y}, 8)")
        click_pixel(page, x, y)
        for camera in CAMERAS:
            for kind, suffix in (("value", ""), ("sigma", ".sigma")):
                body = page.locator(f'.numbers tbody[data-layer="{camera}"]')
                shown = body.evaluate(
                    f"b => [...b.querySelectorAll('[data-{kind}]')].map(c => c.dataset.{kind})"
                )
                pages = open_pages(viewer / f"objects/icon1/icon1_{camera}{suffix}.tif")
                truth = pages.read(y, y + 1)[0, x]
                np.testing.assert_array_equal(np.array(shown, np.float32), truth)
        page.keyboard.press("Escape")


def test_flags_are_told_in_words_and_unseen_pixels_have_no_numbers(browser, address):
    page = open_object(browser, address("file"))
    page.evaluate("levkasViewer.stage.look(62, 41, 8)")
    click_pixel(page, 62, 41)
    page.locator(".numbers-fold summary").click()
    assert "saturated" in page.locator('.numbers tbody[data-layer="vis"] tr').nth(1).inner_text()
    page.evaluate("levkasViewer.stage.look(5, 41, 8)")
    click_pixel(page, 1, 41)
    assert "outside" in page.locator('.numbers tbody[data-layer="vis"] tr').nth(1).inner_text()
    value = page.locator('.numbers tbody[data-layer="vis"] td[data-value]').first
    assert value.get_attribute("data-value") == "nan"
    for curve in page.locator("button.curve").all():
        if curve.inner_text() != "vis":
            curve.click()
    assert "The values are listed below" in page.locator(".spectrum-part .chart").inner_text()


def test_a_veiled_pixel_is_told_coloured_and_not_trusted(browser, address):
    page = open_object(browser, address("file", fragment="#a=vis/flags"))
    page.evaluate("levkasViewer.stage.look(105, 103, 8)")
    page.wait_for_function(SETTLED)
    pause(page, 150)
    colour = MARKS[Flag.VEILED].colour
    assert np.abs(shown_colour(page, 103, 103) - colour).max() < 12
    assert "veiled: brighter" in page.locator(".picker-a .legend").inner_text()
    click_pixel(page, 105, 103)
    page.locator(".numbers-fold summary").click()
    row = page.locator('.numbers tbody[data-layer="vis"] tr').nth(1)
    assert row.inner_text().endswith("veiled") and row.locator(".swatch").count() == 1
    struck = "e => getComputedStyle(e).textDecorationLine"
    assert row.locator(".n").first.evaluate(struck) == "line-through"
    click_pixel(page, 113, 103)  # replaced from its neighbours: an estimate
    assert row.inner_text().endswith("defect, replaced")
    assert row.locator(".n").first.evaluate(struck) == "none"
    # What the page's own table does not name is not to be trusted either.
    page.evaluate("levkasViewer.readout.record.flags.pop()")
    click_pixel(page, 105, 103)
    assert "not reliable" in row.inner_text()
    assert row.locator(".n").first.evaluate(struck) == "line-through"


def test_a_value_that_is_not_to_be_trusted_is_hollow_struck_and_said_in_a_sentence(
    browser, address
):
    page = open_object(browser, address("file"))
    page.evaluate("levkasViewer.stage.look(75, 60, 6)")
    click_pixel(page, 80, 60)
    assert page.locator(".chart .doubt").count() == 0 and page.locator(".doubts").count() == 0
    texts = page.locator(".chart text").all_text_contents()
    assert "Reflectance" in texts and "Wavelength, nm" in texts
    assert page.locator(".chart .bar.width").count() == 3, "R, G and B have a width"
    top = page.locator(".chart").get_attribute("data-top")
    page.get_by_label("Keep this range").check()
    click_pixel(page, 65, 41)
    assert page.locator(".chart").get_attribute("data-top") == top
    sentences = page.locator(".doubts").all_inner_texts()
    assert sentences == [f"1 of {n} bands is saturated here." for n in (8, 5, 3)]
    doubt = page.locator(".chart .doubt")
    assert doubt.count() == 3 and doubt.first.locator("circle").count() == 1
    assert doubt.first.evaluate("g => getComputedStyle(g.querySelector('circle')).fill") == "none"
    assert "saturated" in doubt.first.locator("title").text_content()
    lines = page.locator(".chart polyline.line").evaluate_all(
        "all => all.map(one => one.points.length)"
    )
    assert sorted(lines) == [1, 1, 1, 1, 7], "no line leads through a saturated band"


@pytest.mark.parametrize("how", FLIGHTS)
def test_the_picture_shows_the_render_at_any_zoom(browser, address, viewer, how):
    page = open_object(browser, address(how))
    assert page.evaluate("levkasViewer.stage.left.viewer.drawer.getType()") == "canvas"
    for scale in (3.5, 12):
        page.evaluate(f"levkasViewer.stage.look(75, 65, {scale})")
        page.wait_for_function(SETTLED)
        pause(page, 150)
        for x, y in ((75, 65), (65, 75), (85, 55)):
            difference = np.abs(shown_colour(page, x, y) - rendered(viewer, "vis", x, y))
            assert difference.max() < 40, (scale, x, y)


def test_a_layer_that_was_aligned_by_hand_says_so(browser, address):
    page = open_object(browser, address("file"))
    row = page.locator("li.row", has=page.locator(".by-hand"))
    assert row.locator(".layer-name").inner_text() == "rgb"
    assert row.locator(".by-hand").inner_text() == "Aligned with 4 pairs by hand."


@pytest.mark.parametrize("how", FLIGHTS)
def test_the_curtain_shows_a_left_and_b_right_of_a_visible_line(browser, address, viewer, how):
    page = open_object(browser, address(how, fragment="#a=vis/colour&b=vis/flags"))
    page.keyboard.press("c")
    page.wait_for_function(SETTLED)
    line = page.locator(".curtain")
    assert line.is_visible()
    pause(page, 300)
    left, right = (30, 90), (120, 90)
    assert np.abs(shown_colour(page, *left) - rendered(viewer, "vis", *left)).max() < 40
    assert shown_colour(page, *right).max() < 40  # no flag: nearly black
    box = line.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 2000, box["y"] + 40, steps=3)
    page.mouse.up()
    pause(page, 300)
    assert line.get_attribute("aria-valuenow") == "100"
    assert shown_colour(page, *right).max() > 60


def test_a_page_opened_by_a_link_to_a_comparison_shows_it(browser, address, viewer):
    link = "#a=vis/colour&b=vis/flags&mode=curtain&at=75.0,65.0&scale=4.0&pin=90,70"
    page = open_object(browser, address("file", fragment=link))
    page.wait_for_selector('.place[data-pixel="90,70"]')
    pause(page, 300)
    assert page.evaluate("levkasViewer.stage.left.scale") == pytest.approx(4.0, abs=1e-3)
    assert page.evaluate("levkasViewer.stage.left.centre[0]") == pytest.approx(75.0, abs=0.06)
    assert np.abs(shown_colour(page, 60, 60) - rendered(viewer, "vis", 60, 60)).max() < 40
    assert shown_colour(page, 100, 60).max() < 40


@pytest.mark.slow
def test_webgl_draws_the_same_picture_and_the_same_difference(browser, address, viewer):
    url = address("http").replace("index.html", "index.html?drawer=webgl")
    page = open_object(browser, f"{url}#a=vis/colour&b=rgb/colour")
    if page.evaluate("levkasViewer.stage.left.viewer.drawer.getType()") != "webgl":
        pytest.skip("this Chromium has no WebGL")
    for key, x, y in (("", 75, 65), ("d", 85, 55)):
        if key:
            page.keyboard.press(key)
            page.evaluate("levkasViewer.stage.gain.value = 1")
        page.wait_for_function(SETTLED)
        pause(page, 400)
        expected = rendered(viewer, "vis", x, y)
        if key:
            expected = np.abs(expected - rendered(viewer, "rgb", x, y))
        assert np.abs(shown_colour(page, x, y) - expected).max() < 40


def test_the_curtain_is_moved_with_the_arrow_keys(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("c")
    page.locator(".curtain").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert page.locator(".curtain").get_attribute("aria-valuenow") == "54"


def _pictures(requests):
    """Return requests but those of the layer list's thumbnails and of the page's icon, which come when the browser likes."""
    return [url for url in requests if not url.endswith(("thumbnail.jpg", "icon.svg"))]


@pytest.mark.parametrize("how", FLIGHTS)
def test_space_held_flickers_between_two_preloaded_pictures(browser, address, how):
    page = open_object(browser, address(how, fragment="#a=vis/colour&b=vis/flags"))
    page.evaluate("levkasViewer.stage.flicker.rate = 4")
    page.keyboard.down(" ")
    page.wait_for_function(SETTLED)
    before = len(_pictures(browser.requests))
    seen = page.evaluate(
        """async () => {
          const seen = new Set(), stage = levkasViewer.stage, from = performance.now();
          while (seen.size < 2 && performance.now() - from < 10000) {
            const {visibility} = stage.right.viewer.drawer.canvas.style;
            seen.add(stage.flicker.shown + (stage.right.layers.length && visibility));
            await new Promise(requestAnimationFrame);
          }
          return [...seen].sort();
        }"""
    )
    assert seen == ["ahidden", "b"]
    assert _pictures(browser.requests)[before:] == []
    page.keyboard.up(" ")
    assert page.evaluate("levkasViewer.stage.flicker.running") is False


@pytest.mark.slow
def test_side_by_side_keeps_both_views_on_the_same_place(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("s")
    pause(page, 400)
    page.evaluate("levkasViewer.stage.look(100, 30, 5)")
    pause(page, 300)
    views = page.evaluate(
        "[levkasViewer.stage.left, levkasViewer.stage.right].map(p => [...p.centre, p.scale])"
    )
    np.testing.assert_allclose(*views, atol=1e-3)
    page.locator(".pane.beside").hover()
    page.mouse.wheel(0, -300)
    pause(page, 900)
    views = page.evaluate(
        "[levkasViewer.stage.left, levkasViewer.stage.right].map(p => [...p.centre, p.scale])"
    )
    np.testing.assert_allclose(*views, rtol=1e-3, atol=0.1)


@pytest.mark.slow
def test_a_picture_has_no_difference_from_itself(browser, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&b=vis/colour"))
    page.keyboard.press("d")
    page.wait_for_function(SETTLED)
    pause(page, 300)
    assert shown_colour(page, 75, 65).max() <= 2
    page.keyboard.press("Shift+Digit3")
    page.wait_for_function(SETTLED)
    pause(page, 300)
    assert shown_colour(page, 75, 65).max() > 20


@pytest.mark.slow
def test_digits_choose_layers_and_the_address_remembers(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("3")
    page.locator(".picker-a .picker-line select").select_option("band-2")
    assert page.locator("#caption").inner_text() == "rgb, B"
    page.keyboard.press("1")
    page.locator(".picker-a .picker-line select").select_option("light-a")
    page.wait_for_function("() => location.hash.includes('light-a')")
    again = open_object(browser, page.url)
    assert again.locator("#caption").inner_text() == "vis, A, incandescent lamp"


def test_everything_is_done_with_the_keyboard_alone(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("r")
    page.wait_for_selector(".place[data-pixel]")
    first = page.locator(".place").get_attribute("data-pixel")
    page.keyboard.press("Shift+ArrowRight")
    page.wait_for_function(f"() => document.querySelector('.place').dataset.pixel !== '{first}'")
    x, y = map(int, page.locator(".place").get_attribute("data-pixel").split(","))
    assert (x - 1, y) == tuple(map(int, first.split(",")))
    page.keyboard.press("?")
    assert page.locator("dialog.help").is_visible()
    page.keyboard.press("Escape")
    assert not page.locator("dialog.help").is_visible()
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("document.activeElement.className || document.activeElement.id || ''")
        )
    for part in ("layer", "second", "curve", "back", "stage"):
        assert any(part in name for name in reached), part


@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon1/index.html"])
def test_what_can_be_pressed_has_a_name_for_screen_readers(browser, address, name):
    page = browser.open(address("file", name))
    pause(page, 300)
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('button, a, input, select, [role=slider], [tabindex="0"]')]
          .filter(e => e.checkVisibility() && !e.closest('.openseadragon-container'))
          .filter(e => !(e.ariaLabel || e.textContent.trim() || e.title || e.labels?.length
             || e.getAttribute('aria-label') || e.getAttribute('aria-labelledby') || e.getAttribute('aria-roledescription')))
          .map(e => e.outerHTML)"""
    )
    assert nameless == []
    assert page.locator("html").get_attribute("lang") == "en"
    assert page.locator("main").count() == 1 and page.locator("h1").count() == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon1/index.html"])
def test_light_and_dark_have_text_that_can_be_read(browser, address, name):
    for scheme in ("light", "dark"):
        page = browser.open(address("file", name), scheme=scheme)
        pause(page, 200)
        assert _least_contrast(page) >= 4.5, scheme
        page.locator("#theme").click()
        assert _least_contrast(page) >= 4.5, f"{scheme}, changed"


def _least_contrast(page):
    """Least contrast ratio (WCAG) of body text, soft text and links to the page's ground."""
    return page.evaluate(
        """() => {
          const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
            .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
            return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
          const ground = light(getComputedStyle(document.body).backgroundColor);
          const ratios = [...document.querySelectorAll('.soft, .badge, .colophon p, h1, h2, .subtitle, .maker')]
            .filter(e => e.checkVisibility()).map(e => light(getComputedStyle(e).color))
            .map(l => (Math.max(l, ground) + 0.05) / (Math.min(l, ground) + 0.05));
          return Math.min(...ratios);
        }"""
    )


@pytest.mark.parametrize("name", ["index.html", "viewer/objects/icon2/index.html"])
def test_every_page_says_licence_and_citation_and_links_stay_in_the_folder(
    browser, address, viewer, name
):
    page = browser.open(address("file", name))
    text = page.locator("footer").inner_text()
    assert "CC BY 4.0" in text and "Painter, Ada (2019)" in text
    links = page.evaluate("[...document.querySelectorAll('a[href]')].map(a => a.href)")
    local = [link for link in links if link.startswith("file:")]
    assert len(local) > 2
    for link in local:
        assert Path(unquote(urlsplit(link).path)).is_file(), link
    if "icon2" in name:
        assert any(link.endswith("report.html") for link in local)
        assert page.locator(".reasons").inner_text() == LEFT_OUT


def test_nothing_scrolls_sideways_on_a_narrow_screen(browser, address):
    for name in ("index.html", "viewer/objects/icon1/index.html"):
        page = browser.open(address("file", name), width=360, height=740)
        pause(page, 200)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, name


def test_pages_hold_no_inline_script_and_a_policy_forbids_one(viewer):
    for path in [viewer / "index.html", *viewer.glob("viewer/objects/*/index.html")]:
        text = path.read_text(encoding="utf-8")
        assert "Content-Security-Policy" in text and "default-src &#39;none&#39;" in text
        scripts = re.findall(r"<script\b([^>]*)>", text)
        assert all("src=" in s or 'type="application/json"' in s for s in scripts)
        assert not re.search(r"\son[a-z]+=|javascript:|\sstyle=", text)


def test_the_predicted_error_of_every_registered_camera_can_be_shown(browser, address):
    page = open_object(browser, address("file"))
    for digit in "123":
        page.keyboard.press(digit)
        options = page.locator(".picker-a select").first.locator("option").all_inner_texts()
        assert "Registration error" in options, digit


def keep_places(page):
    for x, y in ((25, 25), (95, 65)):
        click_pixel(page, x, y)
        page.keyboard.press("p")
    page.get_by_label("Name of place 2").fill('=azurite, "dark"')
    page.wait_for_function("() => location.hash.includes('azurite')")


@pytest.mark.slow
def test_kept_places_stand_in_the_address_and_on_the_painting(browser, address):
    page = open_object(browser, address("file"))
    keep_places(page)
    again = open_object(browser, page.url)
    names = [again.get_by_label(f"Name of place {n}").input_value() for n in (1, 2)]
    assert names == ["Place 1", '=azurite, "dark"']
    assert again.locator(".stage .cell-a .kept-pin").count() >= 2
    again.wait_for_selector("#pins svg .line")
    assert again.locator("#pins svg .line").count() == 2
    assert "holds nothing" not in again.locator("#spectrum").inner_text()
    again.get_by_label("Remove Place 1").click()
    assert again.locator(".pins li").count() == 1
    # A link pasted over the page's own is followed; one to a part of the page changes nothing.
    again.evaluate("location.hash = '#stage'")
    assert again.locator(".pins li").count() == 1
    again.evaluate("location.hash = '#a=vis/colour&kept=30,40,Red%20lake&kept=9999,1,far&kept=x'")
    again.wait_for_selector("text=30, 40")
    assert again.locator(".pins li").count() == 1


def test_kept_places_are_saved_with_the_numbers_of_all_cameras(browser, viewer, address):
    page = open_object(browser, address("file"))
    keep_places(page)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save places as CSV").click()
    with Path(download.value.path()).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["place"] for row in rows} == {"Place 1", '\'=azurite, "dark"'}
    pages = open_pages(viewer / "objects/icon1/icon1_vis.tif")
    chosen = [r for r in rows if r["layer"] == "vis" and r["place"] == "Place 1"]
    expected = [pages.read_page(band)[25, 25] for band in range(len(chosen))]
    assert len(chosen) > 3 and np.array_equal([np.float32(r["value"]) for r in chosen], expected)


def test_a_reference_spectrum_lies_over_the_kept_ones_with_its_angle(browser, address, tmp_path):
    page = open_object(browser, address("file"))
    keep_places(page)
    page.wait_for_selector("#pins svg .line")
    bands, values = page.evaluate(
        "async () => { const l = levkasViewer.record.layers.find(l => l.name === 'vis');"
        " const s = levkasViewer.pins.sources.find(s => s.layer === l);"
        " const r = await s.spectra.read(25, 25);"
        " return [l.bands.map(b => b.wavelength), [...r.values]]; }"
    )
    page.get_by_label("Layer whose spectra are compared").select_option("vis")
    path = tmp_path / "lead white.csv"
    path.write_text("".join(f"{nm},{v / 2}\n" for nm, v in zip(bands, values, strict=True)))
    page.get_by_label("File of a reference spectrum").set_input_files(path)
    page.wait_for_selector("text=not an identification")
    angles = page.locator(".angle").all_inner_texts()
    assert angles[0] == "0.0°" and float(angles[1].rstrip("°")) > 0.5
    assert page.locator("#pins svg .line").count() == 3
    (tmp_path / "bad.csv").write_text("<img src=x onerror=alert(1)>\n")
    page.get_by_label("File of a reference spectrum").set_input_files(tmp_path / "bad.csv")
    page.wait_for_selector("text=bad.csv has no spectrum")
    assert page.locator("#pins svg .line").count() == 2


def test_the_next_object_is_looked_at_in_the_same_way(browser, address):
    page = open_object(
        browser, address("file") + "#a=vis/flags&b=vis/colour&mode=curtain&pin=30,40"
    )
    page.wait_for_function("() => location.hash.includes('scale')")
    page.keyboard.press("]")
    page.wait_for_url("**/icon2/**")
    page.wait_for_function("() => levkasViewer.stage.mode.value === 'curtain'")
    page.wait_for_function("() => levkasViewer.state.a.value.picture.key === 'flags'")
    assert page.evaluate("levkasViewer.state.pin.value") is None


def drag(page, start, end):
    first, last = (
        page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})") for x, y in (start, end)
    )
    page.mouse.move(*first)
    page.mouse.down()
    page.mouse.move(*((a + b) / 2 for a, b in zip(first, last, strict=True)))
    page.mouse.move(*last)
    page.mouse.up()


def region_numbers(page):
    page.wait_for_selector("text=one standard deviation")
    return [
        page.locator(".region-row .region-words").nth(i).evaluate("e => ({...e.dataset})")
        for i in range(page.locator(".region-row .region-words").count())
    ]


@pytest.mark.slow
def test_regions_have_the_numbers_of_the_database(browser, viewer, address):
    layer = levkas.open(viewer)["icon1"]["vis"]
    page = open_object(browser, address("file") + "#a=vis/colour")
    page.get_by_label("Layer that regions are measured in").select_option("vis")
    page.get_by_label("Band of the histogram").select_option("2")
    page.get_by_role("button", name="Rectangle", exact=True).click()
    drag(page, (30, 30), (60, 70))
    page.get_by_role("button", name="Circle", exact=True).click()
    drag(page, (90, 60), (100, 60))
    page.get_by_role("button", name="Polygon", exact=True).click()
    for x, y in ((20, 80), (70, 85), (45, 110)):
        page.mouse.click(*page.evaluate(f"levkasViewer.stage.left.pageOf({x}, {y})"))
    page.keyboard.press("Enter")
    page.wait_for_function(
        "() => document.querySelectorAll('.region-row .region-words').length === 3"
    )
    shapes = page.evaluate("levkasViewer.state.regions.value")
    found = region_numbers(page)
    (a, b), (centre, edge) = shapes[0]["points"], shapes[1]["points"]
    corners = [round(v) for v in (*map(min, a, b), *map(max, a, b))]
    expected = [
        layer.levkas.region(rectangle=corners),
        layer.levkas.region(circle=(*centre, float(np.hypot(*np.subtract(edge, centre))))),
        layer.levkas.region([tuple(point) for point in shapes[2]["points"]]),
    ]
    for numbers, one in zip(found, expected, strict=True):
        assert int(numbers["n"]) == int(one["n"][2]) > 100
        assert float(numbers["mean"]) == pytest.approx(float(one["mean"][2]), rel=1e-9)
        assert float(numbers["spread"]) == pytest.approx(float(one["std"][2]), rel=1e-9)
    assert page.locator("#regions .histogram polyline").count() == 3
    # Drawing moved nothing and pinned nothing; afterwards the mouse pans and pins again.
    assert page.evaluate("levkasViewer.state.pin.value") is None
    click_pixel(page, 25, 25)
    page.wait_for_function("() => location.hash.split('region=').length === 4")
    again = open_object(browser, page.url)
    again.wait_for_selector(".region-words")
    again.get_by_label("Band of the histogram").select_option("2")
    again.wait_for_function(
        f"() => document.querySelector('.region-words').dataset.mean === '{found[0]['mean']}'"
    )
    assert [one["n"] for one in region_numbers(again)] == [one["n"] for one in found]
    with again.expect_download() as download:
        again.get_by_role("button", name="Save regions as CSV").click()
    with Path(download.value.path()).open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["layer"] == "vis"]
    assert len(rows) == 3 * layer.sizes["band"]
    assert [int(r["n"]) for r in rows[: layer.sizes["band"]]] == expected[0]["n"].values.tolist()


def test_a_region_can_be_given_up_and_made_without_a_mouse(browser, viewer, address):
    page = open_object(browser, address("file"))
    page.get_by_role("button", name="Polygon", exact=True).click()
    page.mouse.click(*page.evaluate("levkasViewer.stage.left.pageOf(20, 20)"))
    page.keyboard.press("Escape")
    assert page.evaluate("levkasViewer.state.regions.value.length") == 0
    assert page.locator('#regions [aria-pressed="true"]').count() == 0
    page.get_by_role("button", name="What is in view").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector(".region-words")
    (one,) = page.evaluate("levkasViewer.state.regions.value")
    grid = page.evaluate("levkasViewer.record.grid")
    assert one["points"] == [[0, 0], [grid["width"] - 1, grid["height"] - 1]]
    # Most of it are whole tiles, whose sums were published.
    (numbers,) = region_numbers(page)
    layer = levkas.open(viewer)["icon1"]["vis"]
    expected = layer.levkas.region(rectangle=[0, 0, grid["width"] - 1, grid["height"] - 1])
    band = int(page.get_by_label("Band of the histogram").input_value())
    assert int(numbers["n"]) == int(expected["n"][band])
    assert float(numbers["mean"]) == pytest.approx(float(expected["mean"][band]), rel=1e-9)
    assert float(numbers["spread"]) == pytest.approx(float(expected["std"][band]), rel=1e-9)


def corners(page, *places):
    for place in places:
        page.mouse.click(*page.evaluate(f"levkasViewer.stage.left.pageOf({place[0]}, {place[1]})"))


@pytest.mark.slow
def test_lengths_and_areas_are_in_millimetres_and_in_the_address(browser, address):
    page = open_object(browser, address("file"))
    page.keyboard.press("m")
    corners(page, (20, 20), (60, 50), (60, 100))
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Measure a circle").click()
    drag(page, (90, 60), (100, 60))
    page.wait_for_function("() => document.querySelectorAll('#measures li').length === 2")
    line, circle = page.evaluate("levkasViewer.state.measures.value")
    points = np.array(line["points"])
    length = np.hypot(*np.diff(points, axis=0).T).sum() / 1.25
    radius = np.hypot(*np.subtract(*circle["points"])) / 1.25
    words = page.locator("#measures .region-words").all_inner_texts()
    assert float(words[0].removesuffix(" mm")) == pytest.approx(length, rel=1e-3)
    assert length == pytest.approx(80, rel=0.01)
    assert float(words[1].split(" mm²")[0]) == pytest.approx(np.pi * radius**2, rel=1e-3)
    marks = page.locator(".cell-a .region-number").all_text_contents()
    assert marks == [f"M1 {words[0]}", f"M2 {words[1].split(',')[0]}"]
    page.keyboard.press("g")
    assert page.locator(".cell-a .grid-line").count() > 4
    assert "grid 1 cm" in page.locator(".scalebar").inner_text()
    page.wait_for_function("() => location.hash.includes('grid=1')")
    again = open_object(browser, page.url)
    assert again.locator("#measures .region-words").all_inner_texts() == words
    assert again.get_by_label("Show a grid").is_checked()
    with again.expect_download() as download:
        again.get_by_role("button", name="Save measures as CSV").click()
    with Path(download.value.path()).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["length_mm"]) == pytest.approx(length, rel=1e-6)
    assert rows[0]["area_mm2"] == "" and float(rows[1]["area_mm2"]) > 0
    # Lines of the grid are 10 mm apart, the first one at the edge.
    x = again.locator(".cell-a .grid-line").evaluate_all(
        "all => all.filter(l => l.x1.baseVal.value === l.x2.baseVal.value).map(l => l.x1.baseVal.value)"
    )
    scale = again.evaluate("levkasViewer.stage.left.scale")
    np.testing.assert_allclose(np.diff(x), 12.5 * scale, rtol=1e-3)


def test_a_length_is_measured_with_the_keyboard_alone(browser, address):
    page = open_object(browser, address("file"))
    page.evaluate("levkasViewer.state.pin.value = [30, 30]")
    page.keyboard.press("m")
    page.keyboard.press("p")
    for _ in range(10):
        page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("p")
    page.keyboard.press("Enter")
    page.wait_for_selector("#measures li")
    assert page.locator("#measures .region-words").inner_text() == "8 mm"
    assert page.locator(".pins .pin-number.measure").inner_text() == "M1"


@pytest.mark.slow
def test_a_link_holds_rate_curtain_choices_and_range(browser, address):
    page = open_object(browser, address("file", fragment="#a=vis/colour&b=rgb/colour"))
    page.keyboard.press("c")
    page.evaluate("levkasViewer.stage.curtain.move(0.25)")
    page.get_by_label("Layer that regions are measured in").select_option("nir")
    page.get_by_label("Band of the histogram").select_option("1")
    page.get_by_label("Layer whose spectra are compared").select_option("rgb")
    page.evaluate("levkasViewer.stage.look(75, 60, 6)")
    click_pixel(page, 80, 60)
    page.get_by_label("Keep this range").check()
    top = page.locator("#spectrum .chart").get_attribute("data-top")
    for name, value in (("Rate", 4), ("Amplify", 8)):
        page.locator("label.slider", has_text=name).locator("input").evaluate(
            f"e => {{ e.value = {value}; e.dispatchEvent(new Event('input')); }}"
        )
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy link").click()
    page.wait_for_selector("text=Link copied")
    link = page.evaluate("navigator.clipboard.readText()")
    assert link == page.url
    again = open_object(browser, link)
    again.wait_for_selector('.place[data-pixel="80,60"]')
    state = """() => [levkasViewer.stage.mode.value, levkasViewer.stage.curtain.fraction,
      levkasViewer.stage.flicker.rate, levkasViewer.stage.gain.value]"""
    assert again.evaluate(state) == ["curtain", 0.25, 4, 8]
    chosen = {"Layer that regions are measured in": "nir", "Band of the histogram": "1"}
    chosen["Layer whose spectra are compared"] = "rgb"
    for label, value in chosen.items():
        assert again.get_by_label(label).input_value() == value
    assert again.get_by_label("Keep this range").is_checked()
    assert again.locator("#spectrum .chart").get_attribute("data-top") == top
    # A link that says nothing of them, pasted over this one, shows what a fresh page shows.
    again.evaluate("location.hash = '#a=vis/colour'")
    again.wait_for_function("() => levkasViewer.stage.mode.value === 'single'")
    assert again.evaluate(state)[2:] == [2, 4]
    assert again.get_by_label("Band of the histogram").input_value() == "4"
