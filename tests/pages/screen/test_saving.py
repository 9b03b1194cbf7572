"""Plots of the viewer are saved as SVG and CSV, also from file://."""

import csv
import io
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from .test_viewer import click_pixel, drag, open_object, region_numbers

NAMESPACE = "{http://www.w3.org/2000/svg}"


def saved(page, button):
    with page.expect_download() as download:
        page.get_by_role("button", name=button, exact=True).click()
    return Path(download.value.path()), download.value.suggested_filename


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
