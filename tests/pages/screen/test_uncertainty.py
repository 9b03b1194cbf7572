"""Regions and places of the viewer have the uncertainties that the database has."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import levkas
from levkas.building import build, summarise
from levkas.calibration.error_sources import ErrorSource
from levkas.core.cube import Band
from levkas.database.described import Pixels
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import (
    mean_of_region,
    position_sigmas,
    read_budget,
    uncertain_region,
    with_place,
)
from levkas.database.regions import make_region
from levkas.registration.record import Sigma

from .database import CAMERAS, write_database
from .test_saving import saved
from .test_viewer import click_pixel, drag, open_object, region_numbers

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from sigma_of_builds import Camera, scene, write_campaign

CORRELATION = [[0.02, 0.1, 0.02], [0.1, 1.0, 0.1], [0.02, 0.1, 0.02]]
DECLARED = """
[cameras.cam.uncertainty]
wavelength_nm = 1.0
stray_light = 0.002
"""


def rows_of(labels):
    """Return a budget with a row of every kind."""

    def row(name, unit, size, common_to="camera", *, shared=True, zero=0.0):
        sizes = {label: size * (1 + k / 10) for k, label in enumerate(labels)}
        zeros = dict.fromkeys(labels, zero) if zero else {}
        return ErrorSource(name, unit, sizes, common_to, all_bands=shared, zero_at=zeros)

    return [
        row("photons", "reflectance", 0.5, "pixel", shared=False),
        row("white board", "relative", 0.01, "campaign"),
        row("lamp", "relative", 0.02, "line"),
        row("chart", "relative", 0.004, shared=False),
        row("chart of another kind", "relative", 0.003, shared=False),
        row("stray light", "reflectance", 0.02, zero=0.3),
        row("black level", "reflectance", 0.001, shared=False),
        row("curve", "relative", 0.01, zero=0.9),
        row("wavelength", "nm", 1.5, shared=False),
        ErrorSource("linearity", "relative", {}, "camera", all_bands=True, basis="unknown"),
    ]


@pytest.fixture(scope="module")
def database(add_viewer, tmp_path_factory):
    """Return the folder of a published database; errors of `vis` alone are recorded."""
    folder = write_database(tmp_path_factory.mktemp("sure") / "database", {"icon1": "Icon"})
    of = {"camera": "vis", "setup": ""}
    rows = [row.to_dict() for row in rows_of(CAMERAS["vis"])]
    steps = [
        {"stage": "calibrate", **of, "uncertainty": rows},
        {"stage": "resample", **of, "noise_correlation": CORRELATION},
    ]
    path = folder / "objects/icon1/provenance.json"
    path.write_text(json.dumps({"steps": steps}), encoding="utf-8")
    register = folder / "objects/icon1/registration/vis.json"
    record = json.loads(register.read_text())
    for band in record["bands"].values():  # so little known that it counts on slopes
        x, y = np.meshgrid([0.0, 160.0], [0.0, 120.0])
        sigma = 0.5 + 0.004 * x + 0.002 * y
        band["sigma"] = Sigma(x[0], y[:, 0], sigma).to_dict()
    register.write_text(json.dumps(record), encoding="utf-8")
    return add_viewer(folder)


@pytest.fixture
def page(browser, database):
    address = (database / "viewer/objects/icon1/index.html").as_uri()
    found = open_object(browser, address + "#a=vis/colour")
    found.get_by_label("Layer that regions are measured in").select_option("vis")
    return found


def expected(database, **shape):
    """Return the mean of a region with its errors."""
    layer = levkas.open(database)["icon1"]["vis"]
    region = make_region(None, shape.get("rectangle"), shape.get("circle"))
    name = LayerId("icon1", "vis")
    budget = read_budget(database, name)
    pixels = Pixels(layer.values, layer.levkas.flags.values, layer.levkas.sigma.values)
    bands = [
        Band(str(label), float(nm))
        for label, nm in zip(layer.band.values, layer.wavelength.values, strict=True)
    ]
    mean = mean_of_region(pixels, bands, region, budget.correlation)
    labels = [band.label for band in bands]
    x0, y0, x1, y1 = region.bounds
    middle = np.array([[(x0 + x1) / 2, (y0 + y1) / 2]])
    known = position_sigmas(database, name, labels, middle)[0]
    return uncertain_region(mean, with_place(budget, labels, known), name, 0)


def test_regions_have_the_uncertainty_of_the_database(page, database):
    page.get_by_label("Band of the histogram").select_option("2")
    page.get_by_label("Band for ratio and difference").select_option("5")
    page.get_by_role("button", name="Rectangle", exact=True).click()
    drag(page, (20, 50), (33, 58))
    page.get_by_role("button", name="What is in view").click()
    page.wait_for_function("() => document.querySelectorAll('.region-words').length === 2")
    shapes = page.evaluate("levkasViewer.state.regions.value")
    pairs = page.locator(".region-pair")
    found = region_numbers(page)
    # In the second one are flagged pixels, whose neighbours have no noise in common with them, and no slopes of their own.
    for k, rel in enumerate([3e-3, 2e-2]):
        a, b = shapes[k]["points"]
        sure = expected(database, rectangle=(*map(min, a, b), *map(max, a, b)))
        assert float(found[k]["u"]) == pytest.approx(sure.sigma[2], rel=rel)
        for name, of in {"ratio": np.divide, "difference": np.subtract}.items():
            made = sure.through(lambda v, of=of: of(v[2:3], v[5:6]))
            value, u = map(float, pairs.nth(k).get_attribute(f"data-{name}").split(","))
            assert value == pytest.approx(made.values[0], rel=1e-6)
            assert u == pytest.approx(made.sigma[0], rel=rel)
    expanded = 2 * float(found[0]["u"])
    assert f"±\N{NO-BREAK SPACE}{expanded:.2g}" in page.locator(".region-words").first.inner_text()
    words = page.locator("#regions .note-line").inner_text()
    assert words.endswith("; not contained: linearity.") and "± is" in words
    path, _ = saved(page, "Save regions as CSV")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    a, b = shapes[0]["points"]
    sure = expected(database, rectangle=(*map(min, a, b), *map(max, a, b)))
    mine = [row for row in rows if row["layer"] == "vis"][: len(sure.sigma)]
    # How well places are known has three digits there.
    assert [float(row["u"]) for row in mine] == pytest.approx(sure.sigma.tolist(), rel=3e-3)
    assert [float(row["U"]) for row in mine] == pytest.approx((2 * sure.sigma).tolist(), rel=3e-3)
    assert {row["u"] + row["U"] for row in rows if row["layer"] == "nir"} == {""}


def test_a_layer_whose_errors_are_not_recorded_has_no_uncertainty(page):
    page.get_by_label("Layer that regions are measured in").select_option("nir")
    page.get_by_role("button", name="Rectangle", exact=True).click()
    drag(page, (20, 50), (33, 58))
    (numbers,) = region_numbers(page)
    assert numbers["u"] == "" and "±" not in page.locator(".region-words").inner_text()
    assert "not recorded" in page.locator("#regions .note-line").inner_text()


def test_a_place_has_its_noise_and_what_all_pixels_share(page, database):
    click_pixel(page, 80, 60)
    page.keyboard.press("p")
    page.wait_for_selector("#pins .region-words")
    sure = expected(database, rectangle=(80, 60, 80, 60))
    assert sure.by_source()["place"].max() > 0.02 * sure.sigma.max()
    band = page.evaluate("levkasViewer.record.layers.find(l => l.name === 'vis').reference_band")
    page.get_by_label("Layer whose spectra are compared").select_option("vis")
    text = page.locator("#pins .region-words").inner_text()
    assert text.startswith("580 nm: ") and text.endswith(
        f"±\N{NO-BREAK SPACE}{2 * sure.sigma[band]:.2g}"
    )
    cells = page.locator("tbody[data-layer=vis] td[data-expanded]")
    shown = [float(cells.nth(k).get_attribute("data-expanded")) for k in range(cells.count())]
    assert shown == pytest.approx((2 * sure.sigma).tolist(), rel=3e-3)
    path, _ = saved(page, "Save places as CSV")
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["layer"] == "vis"]
    assert [float(row["u"]) for row in rows] == pytest.approx(sure.sigma.tolist(), rel=1e-3)


@pytest.mark.slow
def test_a_built_database_has_the_same_uncertainty_in_the_viewer_and_in_python(
    browser, add_viewer, tmp_path
):
    folder = tmp_path / "c"
    write_campaign(folder, "bands", Camera((100, 140)), scene((100, 140))[0], whites=2)
    text = (folder / "campaign.toml").read_text()
    stated = text.replace("white = {", "white = { uncertainty = 0.01,", 1)
    assert stated != text
    (folder / "campaign.toml").write_text(stated + DECLARED)
    assert summarise(build(folder)).ok
    database = add_viewer(folder / "database")
    page = open_object(browser, (database / "viewer/objects/panel/index.html").as_uri())
    page.get_by_role("button", name="Rectangle", exact=True).click()
    drag(page, (20, 30), (39, 49))
    (numbers,) = region_numbers(page)
    a, b = page.evaluate("levkasViewer.state.regions.value")[0]["points"]
    corners = [round(v) for v in (*map(min, a, b), *map(max, a, b))]
    layer = levkas.open(database)["panel"]["cam"]
    found = layer.levkas.uncertainty(rectangle=corners)
    band = int(page.get_by_label("Band of the histogram").input_value())
    u = float(found.u[band])
    # Neighbours share noise as in a rectangle of even noise.
    assert float(numbers["u"]) == pytest.approx(u, rel=0.01)
    white = float(found.u_by_source.sel(source="white board")[band])
    assert white == pytest.approx(0.01 * float(found.value[band]), rel=0.05) and u > white
    words = page.locator("#regions .note-line").inner_text()
    assert all(name in words for name in found.attrs["not_known"])
