"""What the viewer shows is saved as PNG, and its plots as SVG and CSV, also from file://."""

import csv
import io
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from .serving import pause
from .test_viewer import SETTLED, click_pixel, drag, open_object, region_numbers

NAMESPACE = "{http://www.w3.org/2000/svg}"


def saved(page, button):
    with page.expect_download() as download:
        page.get_by_role("button", name=button, exact=True).click()
    return Path(download.value.path()), download.value.suggested_filename


def picture_of(page):
    """Return the saved picture, and the part of the screen that it should show."""
    page.wait_for_function(SETTLED)
    pause(page, 400)
    page.evaluate("document.getElementById('said').textContent = ''")
    box = page.locator("#stage").bounding_box()
    screen = Image.open(io.BytesIO(page.screenshot(clip=box))).convert("RGB")
    path, name = saved(page, "Save picture")
    return np.asarray(Image.open(path).convert("RGB"), int), np.asarray(screen, int), name


MODES = ["single", "curtain", "opacity", "side", "grid", "difference", "flicker"]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["file", pytest.param("http", marks=pytest.mark.slow)])
def test_the_saved_picture_is_what_the_screen_shows_in_every_mode(browser, address, how):
    page = open_object(browser, address(how, fragment="#a=vis/colour&b=nir/colour&amplify=3"))
    found = {}
    for mode in MODES:
        page.evaluate(f"levkasViewer.stage.setMode('{mode}')")
        if mode == "flicker":
            page.evaluate("levkasViewer.stage.flicker.rate = 0.01")
        picture, screen, name = picture_of(page)
        found[mode] = picture
        assert name == f"icon1_{mode}.png"
        height, width = screen.shape[:2]
        assert picture.shape[1] == width and height + 90 < picture.shape[0] < height + 260
        inner = (slice(40, height - 90), slice(30, width - 30))
        apart = np.abs(picture[:height][inner] - screen[inner]).max(-1)
        # Handles of the curtain and other controls are not in the picture.
        # Pictures beside one another may lie half a pixel off the screen's own: edges differ there.
        beside = mode in ("side", "grid")
        assert (apart > 24).mean() < (0.05 if beside else 0.01) and apart.mean() < 4, mode
        legend = picture[height:]
        assert (legend[2] == 255).all() and 0.005 < (legend < 128).mean() < 0.2
    assert np.abs(found["single"][100:500] - found["difference"][100:500]).mean() > 20


@pytest.mark.slow
def test_a_saved_picture_has_marks_scale_bar_and_words(browser, address, tmp_path):
    page = open_object(browser, address("file", fragment="#a=vis/light-a"))
    without, *_ = picture_of(page)
    page.evaluate(
        "levkasViewer.state.measures.value = [{name: 'M', kind: 'line', points: [[20, 20], [120, 100]]}]"
    )
    click_pixel(page, 60, 30)
    page.evaluate(
        """() => {
          window.words = [];
          const { prototype } = CanvasRenderingContext2D, write = prototype.fillText;
          prototype.fillText = function (text, ...rest) {
            window.words.push(text);
            return write.call(this, text, ...rest);
          };
        }"""
    )
    picture, *_ = picture_of(page)
    words = page.evaluate("words")
    assert {"First icon", page.locator(".scalebar").inner_text()} <= set(words)
    text = " ".join(words)
    assert (
        "vis, A, incandescent lamp" in text
        and "CC BY 4.0" in text
        and "Painter, Ada (2019)" in text
    )
    x, y = page.evaluate("levkasViewer.stage.left.placeOf(70, 60)")
    change = np.abs(picture - without)[round(y) - 3 : round(y) + 4, round(x) - 3 : round(x) + 4]
    assert change.max() > 60, "the measured line is in the picture"


def drawing_of(path):
    """Return the root of an SVG that stands alone: no style, class, script or reference to elsewhere."""
    text = path.read_text("utf-8")
    root = ElementTree.fromstring(text)
    assert root.tag == f"{NAMESPACE}svg" and float(root.get("width")) > 300
    for element in root.iter():
        assert element.tag.removeprefix(NAMESPACE) not in {"script", "style", "image", "a", "use"}
        assert not {n for n in element.attrib if n.startswith("on") or n in ("class", "style")}
    assert "var(" not in text and "http" not in text.replace(
        "http://www.w3.org/2000/svg", ""
    ).replace("https://creativecommons.org", "")
    return root


def shown_alone(browser, path):
    """Return the pixels of an SVG opened by itself."""
    page = browser.open(path.as_uri(), width=800, height=900, scheme="dark")
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), int)


@pytest.mark.slow
def test_every_plot_is_saved_as_svg_that_stands_alone_and_as_csv(browser, address, tmp_path):
    page = open_object(browser, address("file"), scheme="dark")
    click_pixel(page, 80, 60)
    page.keyboard.press("p")
    page.get_by_label("Name of place 1").fill("<b>Sky</b> & sea")
    page.get_by_role("button", name="Rectangle", exact=True).click()
    drag(page, (30, 30), (60, 70))
    (numbers,) = region_numbers(page)
    page.wait_for_selector("#pins svg .line")
    names = [
        "Save as SVG",
        "Save spectra as SVG",
        "Save spectra of regions as SVG",
        "Save histogram as SVG",
    ]
    for number, name in enumerate(names):
        path, suggested = saved(page, name)
        root = drawing_of(path)
        texts = [e.text for e in root.iter(f"{NAMESPACE}text")]
        assert any("Painter, Ada (2019)" in text for text in texts)
        lines = [e for e in root.iter() if e.tag.endswith("polyline")]
        assert lines and all(e.get("fill") == "none" and e.get("stroke") for e in lines)
        copy = tmp_path / suggested
        copy.write_bytes(path.read_bytes())
        image = shown_alone(browser, copy)
        assert (image[5, 5] == 255).all() and 0.003 < (image[:700, :700] < 200).mean() < 0.3, name
        if number == 1:
            assert "<b>Sky</b> & sea" in texts
    assert page.evaluate("document.documentElement.dataset.theme ?? null") is None
    path, suggested = saved(page, "Save histogram as CSV")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert suggested == "icon1_histogram.csv" and len(rows) == 40
    assert sum(int(row["pixels"]) for row in rows) == int(numbers["n"])
    edges = [float(row["from"]) for row in rows]
    assert edges == sorted(edges) and float(rows[-1]["to"]) > edges[-1]
