"""What is told of glare, focus and other lightings of a scan whose lines only pass by."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Band, Cube, CubeRows, Flag
from levkas.database.layers import Layer, write_layer
from levkas.quality.image_quality import sharpness
from levkas.stages import capture_statistics
from levkas.stages.calibrate import develop
from levkas.stages.capture_statistics import (
    DefaultLayer,
    LayerStatistics,
    Middle,
    flag_and_count,
    focus_of,
)
from levkas.stages.exposures import mark_glare_in
from levkas.stages.template_cache import TemplateCache

CAMPAIGN = """
[campaign]
reference = "scan"
[cameras.scan]
kind = "cube"
files = "{target}.hdr"
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.9 }
objects = ["panel"]
"""


def write_envi(folder, name, cube):
    lines, samples, bands = cube.shape
    (folder / f"{name}.raw").write_bytes(cube.transpose(0, 2, 1).astype(np.uint16).tobytes())
    (folder / f"{name}.hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"data type = 12\nbyte order = 0\n"
        f"wavelength = {{{', '.join(str(400 + 50 * b) for b in range(bands))}}}\n"
    )


@pytest.mark.parametrize("tile", ["1", "7", "whole"])
def test_glare_is_flagged_whatever_lines_are_taken_together(tmp_path, monkeypatch, tile):
    rng, shape = np.random.default_rng(1), (30, 20, 5)
    panel = rng.normal(1600, 5, shape)
    panel[11:14, 4:9, 2] = 4600  # 1.35 of a perfect diffuser: no paint is
    panel[20, 3] = 3500  # 1.02: white paint on a slope might be
    levels = {"dark": rng.normal(100, 5, shape), "white": rng.normal(3100, 5, shape)}
    for name, cube in {**levels, "panel": panel}.items():
        write_envi(tmp_path, name, cube)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    campaign = load_campaign(tmp_path)
    (capture,), _ = find_captures(campaign)
    shelf = TemplateCache(tmp_path)
    monkeypatch.setenv("LEVKAS_TILE", tile)
    flags = develop(capture, campaign, shelf).cubes[""].flags
    planted = np.zeros(shape, bool)
    planted[11:14, 4:9, 2] = True
    np.testing.assert_array_equal((flags & Flag.GLARE) != 0, planted)


def test_counts_are_never_glare():
    values, flags = np.full((2, 2, 1), 9.0, np.float32), np.zeros((2, 2, 1), np.uint8)
    assert not mark_glare_in(Cube(values, flags, None, (Band("G"),), "counts")).flags.any()


@pytest.mark.parametrize("rows", [1, 17, 1000])
def test_focus_of_lines_that_pass_by_is_that_of_the_whole_cube(monkeypatch, rows):
    from scipy.ndimage import gaussian_filter

    monkeypatch.setattr(sharpness, "LONGEST", 160)
    monkeypatch.setattr(capture_statistics, "MOST_BANDS", 3)
    rng = np.random.default_rng(2)
    scene = np.kron(rng.random((10, 8)), np.ones((24, 24)))
    stack = [gaussian_filter(scene, 0.7 + 0.25 * b) for b in range(5)]
    values = np.stack(stack, -1).astype(np.float32)
    flags = np.zeros(values.shape, np.uint8)
    flags[100:110, 90:100] = Flag.GLARE
    bands = tuple(Band(f"{b}") for b in range(5))
    middle = Middle(values.shape, bands)
    for y in range(0, len(values), rows):
        part = slice(y, y + rows)
        middle.add(Cube(values[part], flags[part], None, bands, "reflectance"))
    whole = focus_of([Cube(values, flags, None, bands, "reflectance")])
    assert middle.focus() == whole
    assert [one["band"] for one in whole] == ["0", "2", "4"]
    blurs = [one["blur_px"] for one in whole]
    assert blurs == pytest.approx([np.sqrt(b**2 + 1 / 12) for b in (0.7, 1.2, 1.7)], rel=0.12)


@pytest.fixture
def two_setups(tmp_path):
    """A painting of 96 x 120 px under two lightings, the default one published."""
    rng = np.random.default_rng(4)
    paint = np.kron(rng.uniform(0.05, 0.7, (12, 15, 3)), np.ones((8, 8, 1))).astype(np.float32)
    bands = tuple(Band(str(b)) for b in range(3))
    default = Cube(paint, np.zeros(paint.shape, np.uint8), None, bands, "reflectance")
    write_layer(tmp_path, Layer("icon", "scan"), default)
    base = tmp_path / "objects" / "icon" / "icon_scan"
    layer = DefaultLayer.open(base.with_suffix(".tif"), base.with_suffix(".flags.tif"), paint.shape)
    shown = paint * np.array([1.1, 1.05, 0.95], np.float32)
    shown[30:50, 40:80] += 0.3
    return layer, Cube(shown, default.flags, None, bands, "reflectance")


def test_a_default_layer_of_another_size_is_not_compared_with(two_setups, tmp_path):
    base = tmp_path / "objects" / "icon" / "icon_scan"
    paths = base.with_suffix(".tif"), base.with_suffix(".flags.tif")
    assert DefaultLayer.open(*paths, (96, 121, 3)) is None
    assert DefaultLayer.open(tmp_path / "none.tif", paths[1], (96, 120, 3)) is None


@pytest.mark.parametrize("rows", [1, 13, 96])
def test_rows_of_another_setup_are_compared_with_the_default_ones(two_setups, rows):
    layer, cube = two_setups
    gains = np.array([1.1, 1.05, 0.95], np.float32)
    whole = Cube(cube.values, cube.flags.copy(), None, cube.bands, cube.quantity)
    reported = flag_and_count(whole, layer.rows(), gains)
    planted = np.zeros(whole.flags.shape, bool)
    planted[30:50, 40:80] = True
    assert reported["veiled"] == 800
    np.testing.assert_array_equal((whole.flags & Flag.VEILED) != 0, planted)
    statistics = LayerStatistics(layer, gains)
    blocks = [
        Cube(
            cube.values[y : y + rows],
            cube.flags[y : y + rows].copy(),
            None,
            cube.bands,
            cube.quantity,
        )
        for y in range(0, 96, rows)
    ]
    parts = CubeRows(blocks, whole.shape, cube.bands, cube.quantity, has_sigma=False)
    flags = np.concatenate([block.flags for block in statistics.flagged(parts).blocks])
    np.testing.assert_array_equal(flags, whole.flags)
    assert statistics.glare == reported | {"inside": 96 * 120}


@pytest.mark.parametrize("rows", [7, 64, 1000])
def test_the_map_of_sigma_is_noted_alike_in_blocks_of_any_height(rows):
    """A ramp of sigma from left to right, alike in all bands but one that knows none, and nowhere known in the first rows."""
    height, width = 1000, 500
    ramp = np.linspace(0.01, 0.02, width, dtype=np.float32)
    sigma = np.broadcast_to(ramp[None, :, None], (height, width, 3)).copy()
    sigma[..., 1], sigma[:60] = np.nan, np.nan
    bands = tuple(Band(f"{nm} nm", nm) for nm in (500, 600, 700))
    blocks = [
        Cube(np.ones_like(part), np.zeros(part.shape, np.uint8), part, bands, "reflectance")
        for part in (sigma[y : y + rows] for y in range(0, height, rows))
    ]
    statistics = LayerStatistics(step=16)
    parts = CubeRows(iter(blocks), sigma.shape, bands, "reflectance", has_sigma=True)
    list(statistics.flagged(parts).blocks)
    noted = statistics.sigma_map()["sigma_map"]
    levels = np.asarray(Image.open(io.BytesIO(base64.b64decode(noted["png"])))).astype(float)
    assert levels.shape == (334, 167)  # every third pixel: 360 are the most
    assert (levels[:20] == 0).all()
    assert noted["least"] == pytest.approx(0.0101, abs=6e-5)
    assert noted["most"] == pytest.approx(0.0199, abs=6e-5)
    shown = noted["least"] + (levels[20:] - 1) / 254 * (noted["most"] - noted["least"])
    np.testing.assert_allclose(shown, np.tile(ramp[::3], (314, 1)), atol=1.5e-4)
