"""Line scans, calibrated by blocks of lines: as the whole is, to the last bit, however many lines are taken together."""

import base64
import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import (
    Habits,
    developed,
    errors,
    frames,
    key,
    referenced,
    set_at,
    text,
    tones,
    write,
    write_scan,
)
from PIL import Image
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parents[1]))
from world import write_campaign as write_world

from levkas.building import build, summarise
from levkas.core import disk
from levkas.core.cube import Band, Cube, CubeRows, Flag
from levkas.core.digests import hash_tree
from levkas.database.layers import Layer, write_layer
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.quality.image_quality import sharpness
from levkas.stages import capture_statistics, parts, scan_templates, scans
from levkas.stages.capture_statistics import (
    DefaultLayer,
    LayerStatistics,
    Middle,
    flag_and_count,
    focus_of,
)
from levkas.stages.exposures import mark_glare_in
from levkas.stages.scans import is_streamed, open_scan
from levkas.stages.template_cache import TemplateCache


@pytest.fixture
def scan_and_cube(tmp_path, monkeypatch):
    """A scan of 80 lines of 100 samples in three bands, a value of which is no number, and its cube."""
    folder = write(tmp_path / "c", "cube", set_at("panel.hdr", (7, 5, 2), np.nan), referenced)
    made = developed(folder)
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    assert is_streamed(made.capture, made.campaign)
    return open_scan(made.capture, made.campaign, TemplateCache(folder / "streamed")), made.cube


def same(a, b):
    pairs = ((a.values, b.values), (a.flags, b.flags), (a.sigma, b.sigma))
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)


@pytest.mark.parametrize("samples", [1, 4 * 10**4])
def test_a_line_is_calibrated_alike_in_any_block(scan_and_cube, monkeypatch, samples):
    scan, cube = scan_and_cube
    monkeypatch.setattr(scan_templates, "BLOCK_SAMPLES", samples)
    (part,) = scan.parts
    assert same(part.whole(), cube)
    for rows in ((7, 20), (12, 31)):  # what both have in common is calibrated once
        assert np.array_equal(part.rows(*rows).values, cube.values[slice(*rows)])


def test_pictures_are_block_means_of_what_is_there(scan_and_cube, monkeypatch):
    scan, cube = scan_and_cube
    monkeypatch.setattr(scans, "LOOKED_AT_PX", cube.values[..., 0].size // 9 + 1)
    image = scan.images()[1]
    assert scan.factor == 3
    h, w = image.values.shape
    blocks = cube.values[: 3 * h, : 3 * w, 1].reshape(h, 3, w, 3)
    sound = (cube.flags[: 3 * h, : 3 * w, 1].reshape(h, 3, w, 3) == 0).all((1, 3))
    assert sound.any()
    assert np.allclose(image.values[sound], blocks.mean((1, 3))[sound], atol=1e-6)


def joined(scan, maps, size, spool):
    named = dict(zip([band.label for band in scan.bands], maps, strict=True))
    blocks = list(parts.on_grid(scan, named, size, spool=spool).cube().blocks)
    assert not list(spool.iterdir())
    whole = (np.concatenate([getattr(b, n) for b in blocks]) for n in ("values", "flags", "sigma"))
    return len(blocks), *whole


@pytest.mark.parametrize(
    "quarter",
    [False, pytest.param(True, marks=pytest.mark.exhaustive)],
    ids=["upright", "on its side"],
)
def test_rows_are_resampled_as_the_whole_is(scan_and_cube, monkeypatch, tmp_path, quarter):
    scan, cube = scan_and_cube
    h, w = cube.values.shape[:2]
    matrix = np.array([[1.0203, 0.01007, -2.0131], [-0.01003, 1.0507, 3.0171]])
    size = (w + 5, h - 2)
    if quarter:
        matrix, size = matrix[::-1], (size[1], size[0])
    maps = [Affine(matrix + np.array([[0, 0, 0.02 * b], [0, 0, 0]])) for b in range(3)]
    shape, spool = (size[1], size[0]), tmp_path / "spool"
    spool.mkdir()
    whole = warp(cube.values, maps, shape, flags=cube.flags, variance=np.square(cube.sigma))
    monkeypatch.setattr(parts, "BUFFER_BYTES", 9 * 3 * w * 30)
    count, values, flags, sigma = joined(scan, maps, size, spool)
    assert count > 2
    assert np.array_equal(flags & Flag.OUTSIDE, whole.flags & Flag.OUTSIDE)
    assert_rounded_alike(values, sigma, whole.values)
    assert np.nanmax(np.abs(sigma / np.sqrt(whole.variance) - 1)) < 0.005
    for tile in ("11", "whole"):  # neither a part of a strip nor a multiple of it
        monkeypatch.setenv("LEVKAS_TILE", tile)
        _, *again = joined(scan, maps, size, spool)
        for part, first in zip(again, (values, flags, sigma), strict=True):
            assert np.array_equal(part, first, equal_nan=part.dtype.kind == "f")


def assert_rounded_alike(values, sigma, whole):
    """Half a step of at most a tenth of sigma lies between what is stored and what was computed."""
    np.testing.assert_array_equal(np.isnan(values), np.isnan(whole))
    known = np.isfinite(whole)
    assert (np.abs(values - whole) <= 0.05 * sigma + 1e-4)[known].all()


def test_of_a_scan_that_lies_askew_many_lines_are_held_and_a_very_large_one_is_refused(
    scan_and_cube, monkeypatch, tmp_path
):
    scan, cube = scan_and_cube
    (tmp_path / "spool").mkdir()
    maps = [Affine(np.array([[0.7, -0.7, 20], [0.7, 0.7, 0]]))] * 3
    monkeypatch.setattr(parts, "BUFFER_BYTES", 9 * 3 * cube.values.shape[1] * 30)
    _, values, _, sigma = joined(scan, maps, (40, 40), tmp_path / "spool")
    whole = warp(cube.values, maps, (40, 40), flags=cube.flags)
    assert np.isfinite(values).any()
    assert_rounded_alike(values, sigma, whole.values)
    monkeypatch.setattr(parts, "ASKEW_BYTES", parts.BUFFER_BYTES)
    with pytest.raises(parts.ScanRefused):
        joined(scan, maps, (40, 40), tmp_path / "spool")


@pytest.mark.parametrize("step", [7, 1000])
def test_rows_are_written_as_the_whole_is(tmp_path, step):
    rng, shape = np.random.default_rng(5), (150, 90, 12)
    values = rng.uniform(0, 1, shape).astype(np.float32)
    flags, sigma = (rng.random(shape) < 0.01).astype(np.uint8), (values / 50).astype(np.float32)
    bands = tuple(Band(f"{w} nm", float(w)) for w in range(400, 1000, 50))
    layer = Layer("icon", "v10")
    write_layer(tmp_path / "whole", layer, Cube(values, flags, sigma, bands, "reflectance"))
    some = (slice(y, y + step) for y in range(0, shape[0], step))
    blocks = [Cube(values[p], flags[p], sigma[p], bands, "reflectance") for p in some]
    rows = CubeRows(blocks, shape, bands, "reflectance", has_sigma=True)
    entry, files = write_layer(tmp_path / "rows", layer, rows)
    assert hash_tree(tmp_path / "rows") == hash_tree(tmp_path / "whole")
    assert entry.bands == 12 and all(path.is_file() for path in files)


@pytest.mark.slow
def test_a_streamed_scan_is_built_to_the_bytes_of_a_whole_one_by_any_rows(tmp_path, monkeypatch):
    """Of the small world the photograph, and the scan in two strips."""
    folder, trees = write_world(tmp_path / "c"), {}
    keys = (folder / "campaign.toml").read_text()
    for camera in ("filters", "colour", "xray"):
        keys = re.sub(rf"(?s)\[cameras\.{camera}\].*?(?=\n\[)", "", keys)
    (folder / "campaign.toml").write_text(
        keys.replace('charts = { macbeth = "ColorChecker24" }', "")
    )
    for name, most, tile in (("whole", 10**9, ""), ("streamed", 0, ""), ("rows", 0, "23")):
        monkeypatch.setattr(scans, "STREAMED_SAMPLES", most)
        monkeypatch.setenv("LEVKAS_TILE", tile)
        report = summarise(build(folder, output=tmp_path / name))
        assert report.ok, report.text
        trees[name] = hash_tree(tmp_path / name)
    assert trees["streamed"] == trees["rows"]
    differ = {n for n in trees["whole"] if trees["whole"][n] != trees["rows"].get(n)}
    assert differ <= {"objects/panel/report.html", "manifest-sha256.txt"}


def test_a_full_disk_is_foreseen_before_a_stage_writes(tmp_path, monkeypatch):
    folder = write(tmp_path / "c", "cube")
    monkeypatch.setattr(disk, "_free_bytes", lambda folder: 5_000)
    first = summarise(build(folder, output=tmp_path / "database")).problems[0]
    assert first.code == "E_DISK_FULL" and int(str(first.expected).split()[0]) > 5_000
    assert not list((tmp_path / "database").rglob("*.tif"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cube", "mirror"])
def test_hysime_takes_away_the_same_noise_in_any_lines(tmp_path, monkeypatch, kind):
    rng, at = np.random.default_rng(3), np.linspace(0, 1, 60)
    spectra = np.array([np.exp(-(((at - c) / 0.15) ** 2)) + 0.1 for c in np.linspace(0, 1, 5)])
    folder = write(tmp_path / "c", kind, key('denoise = "hysime"'), shape=(80, 60))
    signal = 3000 * rng.dirichlet(np.full(5, 0.5), (40, 60)) @ spectra
    nm = "{" + ", ".join(str(400 + 8 * b) for b in range(60)) + "}"
    for name, level in (("dark", 0), ("white", 3000), ("panel", signal)):
        counts = 100 + level + rng.normal(0, 8, signal.shape)
        write_scan(folder / f"raw/{name}.hdr", counts.round().astype(np.uint16), wavelength=nm)
    monkeypatch.setenv("LEVKAS_TILE", "7")
    found = developed(folder)
    monkeypatch.setenv("LEVKAS_TILE", "whole")
    whole = developed(folder)
    assert same(found.cube, whole.cube) and found.words == whole.words
    assert found.told("5 of 60")


@pytest.mark.parametrize("most", [2_000_000, 8000])  # all samples, every third
def test_a_mirror_scan_is_as_exact_as_its_sigma_says(tmp_path, monkeypatch, most):
    monkeypatch.setattr(scan_templates, "MOST_VALUES", most)
    made = developed(write(tmp_path / "c", "mirror", vignette=0.3))
    assert made.measured["sensor"]["gain"] == pytest.approx(Habits().gain, rel=0.06)
    bias, error, spread = errors(made, "mirror")
    assert abs(bias) < 0.003 + 4 * error and spread == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("tile", ["1", "7"])
def test_lines_of_a_mirror_scan_do_not_depend_on_those_taken_together(tmp_path, monkeypatch, tile):
    folder = write(
        tmp_path / "c",
        "mirror",
        frames("panel.hdr", lambda c: np.where(tones(c.shape[:2])[0][..., None] > 0.9, 4095, c).astype("u2")),
    )  # fmt: skip
    made = []
    for rows in (tile, "whole"):
        monkeypatch.setenv("LEVKAS_TILE", rows)
        made.append(developed(folder))
    assert same(made[0].cube, made[1].cube) and (made[0].cube.flags & Flag.SATURATED).any()
    assert made[0].words == made[1].words and made[0].measured == made[1].measured


@pytest.mark.parametrize("tile", ["1", "7", "whole"])
def test_glare_is_flagged_whatever_lines_are_taken_together(tmp_path, monkeypatch, tile):
    """1.35 of a perfect diffuser: no paint is; white paint on a slope might be 1.02."""
    truth = 0.8 * tones((80, 100))[0]
    truth = np.repeat(truth[..., None], 3, 2)
    truth[11:14, 4:9, 2], truth[20, 3] = 1.5, 1.02
    monkeypatch.setenv("LEVKAS_TILE", tile)
    flags = developed(write(tmp_path / "c", "cube", truth=truth, light=2000.0)).cube.flags
    planted = np.zeros(flags.shape, bool)
    planted[11:14, 4:9, 2] = True
    np.testing.assert_array_equal((flags & Flag.GLARE) != 0, planted)


def test_a_mirror_scan_may_be_without_dark_or_white(tmp_path):
    no_white = text('white = { names = "white", reflectance = 1.0 }\n', "")
    counts = developed(write(tmp_path / "c", "mirror", no_white)).cube
    assert counts.sigma is None and counts.quantity == "counts"
    made = developed(write(tmp_path / "d", "mirror", text('dark = "dark"\n', ""), black=2.0))
    assert made.cube.quantity == "reflectance" and abs(errors(made, "mirror")[0]) < 0.02


def test_a_mirror_scan_counts_three_times(tmp_path, monkeypatch):
    made = developed(write(tmp_path / "c", "mirror", referenced))
    size = made.cube.values.size
    for most, streamed in ((3 * size - 1, True), (3 * size, False)):
        monkeypatch.setattr(scans, "STREAMED_SAMPLES", most)
        assert is_streamed(made.capture, made.campaign) == streamed


# --- what is told of lines that only pass by


def test_counts_are_never_glare():
    values, flags = np.full((2, 2, 1), 9.0, np.float32), np.zeros((2, 2, 1), np.uint8)
    assert not mark_glare_in(Cube(values, flags, None, (Band("G"),), "counts")).flags.any()


@pytest.mark.parametrize("rows", [1, 17, 1000])
def test_focus_of_lines_that_pass_by_is_that_of_the_whole_cube(monkeypatch, rows):
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


@pytest.mark.parametrize("rows", [1, 13, 96])
def test_rows_of_another_setup_are_compared_with_the_default_ones(two_setups, tmp_path, rows):
    layer, cube = two_setups
    base = tmp_path / "objects/icon/icon_scan"
    paths = base.with_suffix(".tif"), base.with_suffix(".flags.tif")
    assert DefaultLayer.open(*paths, (96, 121, 3)) is None
    gains = np.array([1.1, 1.05, 0.95], np.float32)
    whole = Cube(cube.values, cube.flags.copy(), None, cube.bands, cube.quantity)
    reported = flag_and_count(whole, layer.rows(), gains)
    planted = np.zeros(whole.flags.shape, bool)
    planted[30:50, 40:80] = True
    assert reported["veiled"] == 800
    np.testing.assert_array_equal((whole.flags & Flag.VEILED) != 0, planted)
    statistics = LayerStatistics(layer, gains)
    some = (slice(y, y + rows) for y in range(0, 96, rows))
    blocks = [replace(cube, values=cube.values[p], flags=cube.flags[p].copy()) for p in some]
    passing = CubeRows(blocks, whole.shape, cube.bands, cube.quantity, has_sigma=False)
    flags = np.concatenate([block.flags for block in statistics.flagged(passing).blocks])
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
    passing = CubeRows(iter(blocks), sigma.shape, bands, "reflectance", has_sigma=True)
    list(statistics.flagged(passing).blocks)
    noted = statistics.sigma_map()["sigma_map"]
    levels = np.asarray(Image.open(io.BytesIO(base64.b64decode(noted["png"])))).astype(float)
    assert levels.shape == (334, 167)  # every third pixel: 360 are the most
    assert (levels[:20] == 0).all()
    assert noted["least"] == pytest.approx(0.0101, abs=6e-5)
    assert noted["most"] == pytest.approx(0.0199, abs=6e-5)
    shown = noted["least"] + (levels[20:] - 1) / 254 * (noted["most"] - noted["least"])
    np.testing.assert_allclose(shown, np.tile(ramp[::3], (314, 1)), atol=1.5e-4)
