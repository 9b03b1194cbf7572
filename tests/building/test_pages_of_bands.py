"""TIFFs whose pages are bands, each page with its wavelength or label, in another order than another file or campaign.toml."""

from itertools import permutations

import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build, summarise
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look, write_campaign
from levkas.core.problems import Refused
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

SIZE, CENTRES = (96, 110), (450, 550, 650)
LAMP, BLACK = np.array([0.5, 1.0, 1.6]), np.array([50, 60, 75])
CAMPAIGN = """
[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "KIND"
files = "raw/{target}.tif"
MORE
[targets]
dark = "dark"
white = "white"
objects = ["panel"]
"""


def truth():
    rng = np.random.default_rng(5)
    made, (y, x) = np.zeros((*SIZE, 3)), np.indices(SIZE)
    for _ in range(60):
        cy, cx, s, a = *rng.uniform(0, SIZE), rng.uniform(2, 12), rng.normal()
        blob = a * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * s * s))
        made += blob[..., None] * rng.uniform(0.3, 1.4, 3)
    return 0.05 + 0.8 / (1 + np.exp(-2 * made))


TRUTH = truth()


def imagej(path, pages, names):
    tifffile.imwrite(path, pages, imagej=True, metadata={"Labels": list(names)})


def described(path, pages, names):
    with tifffile.TiffWriter(path) as tiff:
        for page, name in zip(pages, names, strict=True):
            tiff.write(page, metadata=None, description=name)


def make(folder, write, orders=None, *, names=None, kind="cube", more=""):
    """Write dark, white and panel, each with its pages in an order of its own; the codes of a page are those of its band."""
    rng = np.random.default_rng(2)
    names = names or [f"{nm} nm" for nm in CENTRES]
    (folder / "raw").mkdir(parents=True)
    for target, light in (("dark", 0 * TRUTH), ("white", 1 + 0 * TRUTH), ("panel", TRUTH)):
        counts = np.rint(BLACK + 1500 * LAMP * light + rng.normal(0, 2, TRUTH.shape))
        order = list((orders or {}).get(target, range(3)))
        pages = np.moveaxis(counts[..., order].astype(np.uint16), 2, 0)
        write(folder / f"raw/{target}.tif", np.ascontiguousarray(pages), [names[i] for i in order])
    text = CAMPAIGN.replace("KIND", kind).replace("MORE", more)
    (folder / "campaign.toml").write_text(text)
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused
    native = develop(capture, campaign, TemplateCache(folder))
    return native.cubes[""], native.warnings


def errors(values, order=range(3)):
    return np.nanmedian(np.abs(values - TRUTH[..., list(order)]), (0, 1))


@pytest.mark.parametrize("kind", ["cube", "bands"])
@pytest.mark.parametrize("role", ["white", "dark", "panel"])
@pytest.mark.parametrize("write", [imagej, described])
def test_pages_in_another_order_are_matched_by_their_wavelengths(tmp_path, write, role, kind):
    folder = make(tmp_path / "c", write, {role: (2, 0, 1)}, kind=kind)
    cube, said = developed(folder)
    order = (2, 0, 1) if role == "panel" else range(3)
    assert [band.wavelength for band in cube.bands] == [CENTRES[i] for i in order]
    assert errors(cube.values, order).max() < 0.003
    assert any("another order" in warning for warning in said)


@pytest.mark.parametrize("kind", ["cube", "bands"])
@pytest.mark.parametrize("order", list(permutations(range(3)))[1:])
def test_pages_in_another_order_are_matched_by_their_labels(tmp_path, order, kind):
    folder = make(tmp_path / "c", imagej, {"white": order}, names=["UV", "R", "IR"], kind=kind)
    cube, said = developed(folder)
    assert errors(cube.values).max() < 0.003
    assert any("another order" in warning for warning in said)


def test_pages_whose_labels_are_names_of_files_stand_as_they_are(tmp_path):
    folder = make(tmp_path / "c", imagej, names=["a.tif", "b.tif", "c.tif"])
    imagej(folder / "raw/white.tif", tifffile.imread(folder / "raw/white.tif"), "xyz")
    cube, said = developed(folder)
    assert errors(cube.values).max() < 0.003
    assert not any("order" in warning for warning in said)


@pytest.mark.slow
def test_a_whole_build_of_pages_exchanges_no_bands(tmp_path):
    """campaign.toml has 450, 550, 650, the file 650, 550, 450: refused; without the key the file's own are published."""
    declared = f"wavelengths = {list(CENTRES)}"
    folder = make(tmp_path / "c", imagej, {"panel": (2, 1, 0)}, more=declared)
    with pytest.raises(Refused) as refused:
        list(build(folder))
    (problem,) = refused.value.problems
    assert "650 nm" in problem.found and "450 nm" in problem.expected, problem
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text.replace(declared, ""))
    report = summarise(build(folder))
    assert report.ok, report.text
    cube = levkas.open(folder / "database")["panel"]["cam"]
    assert list(cube.wavelength.values) == [650, 550, 450]
    assert errors(cube.values, (2, 1, 0)).max() < 0.01  # resampled; exchanged bands are 0.026 off


def test_wavelengths_of_pages_are_those_of_a_proposed_campaign(tmp_path):
    folder = make(tmp_path / "c", imagej, dict.fromkeys(("dark", "white", "panel"), (2, 1, 0)))
    (folder / "campaign.toml").unlink()
    write_campaign(look(folder))
    campaign = load_campaign(folder)
    (capture,), _ = find_captures(campaign)
    assert [band.wavelength for band in capture.bands] == [650, 550, 450]
