"""Line scans, calibrated by blocks of lines; those larger than memory are shown with lowered limits."""

import json
import shutil

import numpy as np
import pytest
import tifffile

from levkas.building import build, summarise
from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core import disk
from levkas.core.cube import Band, Cube, CubeRows, Flag
from levkas.core.digests import hash_tree
from levkas.database.layers import Layer, write_layer
from levkas.database.spectral_tiff import read_stiff
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.stages import register, scan_templates, scans, streaming
from levkas.stages.calibrate import develop
from levkas.stages.scans import Scan, is_streamed, open_scan
from levkas.stages.streaming import BufferedLines
from levkas.stages.template_cache import TemplateCache


@pytest.fixture
def scan_and_cube(small_scan, monkeypatch):
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    campaign = load_campaign(small_scan)
    capture = next(c for c in find_captures(campaign)[0] if c.camera == "v10")
    assert is_streamed(capture, campaign)
    shelf = TemplateCache(small_scan)
    cube = next(iter(develop(capture, campaign, shelf).cubes.values()))
    return open_scan(capture, campaign, shelf), cube


def same(a, b):
    pairs = ((a.values, b.values), (a.flags, b.flags), (a.sigma, b.sigma))
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)


@pytest.mark.parametrize("samples", [1, 4 * 10**4])
def test_a_line_is_calibrated_alike_in_any_block(scan_and_cube, monkeypatch, samples):
    scan, cube = scan_and_cube
    monkeypatch.setattr(scan_templates, "BLOCK_SAMPLES", samples)
    assert same(scan.whole()[0], cube)
    blocks = list(scan.blocks(7, 20))
    assert len(blocks) == (13 if samples == 1 else 2)
    assert np.array_equal(np.concatenate([c.values for c in blocks]), cube.values[7:20])


def test_pictures_are_block_means_of_what_is_there(scan_and_cube, monkeypatch):
    scan, cube = scan_and_cube
    monkeypatch.setattr(scans, "LOOKED_AT_PX", cube.values[..., 0].size // 9 + 1)
    assert scan.factor == 3
    image = scan.images()[4]
    h, w = image.values.shape
    blocks = cube.values[: 3 * h, : 3 * w, 4].reshape(h, 3, w, 3)
    sound = (cube.flags[: 3 * h, : 3 * w, 4].reshape(h, 3, w, 3) == 0).all((1, 3))
    assert sound.any()
    assert np.allclose(image.values[sound], blocks.mean((1, 3))[sound], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("quarter", [False, True], ids=["upright", "on its side"])
def test_rows_are_resampled_as_the_whole_is(scan_and_cube, monkeypatch, tmp_path, quarter):
    scan, cube = scan_and_cube
    h, w = cube.values.shape[:2]
    matrix = np.array([[1.0203, 0.01007, -2.0131], [-0.01003, 1.0507, 3.0171]])
    size = (w + 5, h - 2)
    if quarter:
        matrix, size = matrix[::-1], (size[1], size[0])
    maps = [
        Affine(matrix + np.array([[0, 0, 0.02 * b], [0, 0, 0]])) for b in range(len(cube.bands))
    ]
    whole = warp(
        cube.values, maps, (size[1], size[0]), flags=cube.flags, variance=np.square(cube.sigma)
    )
    held = 9 * len(cube.bands) * w * 30
    monkeypatch.setattr(streaming, "BUFFER_BYTES", held)
    blocks = list(streaming.resample_scan(scan, maps, size, spool=tmp_path).blocks)
    assert len(blocks) > 2
    values = np.concatenate([b.values for b in blocks])
    flags = np.concatenate([b.flags for b in blocks])
    sigma = np.concatenate([b.sigma for b in blocks])
    assert np.array_equal(flags & Flag.OUTSIDE, whole.flags & Flag.OUTSIDE)
    assert_rounded_alike(values, sigma, whole.values)
    assert np.nanmax(np.abs(sigma / np.sqrt(whole.variance) - 1)) < 0.005
    for tile in ("11", "whole"):  # neither a part of a strip nor a multiple of it
        monkeypatch.setenv("LEVKAS_TILE", tile)
        others = list(streaming.resample_scan(scan, maps, size, spool=tmp_path).blocks)
        assert len(others) != len(blocks)
        assert np.array_equal(np.concatenate([b.values for b in others]), values, equal_nan=True)
        assert np.array_equal(np.concatenate([b.flags for b in others]), flags)
        assert np.array_equal(np.concatenate([b.sigma for b in others]), sigma, equal_nan=True)
    assert not list(tmp_path.iterdir())


def assert_rounded_alike(values, sigma, whole):
    """Half a step of at most a tenth of sigma lies between what is stored and what was computed."""
    np.testing.assert_array_equal(np.isnan(values), np.isnan(whole))
    known = np.isfinite(whole)
    assert (np.abs(values - whole) <= 0.05 * sigma + 1e-4)[known].all()


def test_lines_that_two_strips_share_are_calibrated_once(scan_and_cube, monkeypatch):
    scan, cube = scan_and_cube
    found, blocks = [], Scan.blocks

    def noting(self, start, stop):
        found.extend([(start, stop)] if start < stop else [])
        return blocks(self, start, stop)

    monkeypatch.setattr(Scan, "blocks", noting)
    held = BufferedLines(scan)
    spans = [(0, 9), (5, 12), (11, 30), (12, 20), (3, 8), (40, 44), (42, 43)]
    for start, stop in spans:
        part = held.hold(start, stop)
        assert np.array_equal(part.values, cube.values[start:stop])
        assert np.array_equal(part.flags, cube.flags[start:stop])
        variance = np.square(cube.sigma[start:stop])
        assert np.array_equal(part.sigma, variance, equal_nan=True)
    assert found == [(0, 9), (9, 12), (12, 30), (3, 8), (40, 44)]


def test_of_a_scan_that_lies_askew_many_lines_are_held_and_a_very_large_one_is_refused(
    scan_and_cube, monkeypatch, tmp_path
):
    scan, cube = scan_and_cube
    maps = [Affine(np.array([[0.7, -0.7, 20], [0.7, 0.7, 0]]))] * len(cube.bands)
    monkeypatch.setattr(streaming, "BUFFER_BYTES", 9 * len(cube.bands) * cube.values.shape[1] * 30)
    blocks = list(streaming.resample_scan(scan, maps, (40, 40), spool=tmp_path).blocks)
    whole = warp(cube.values, maps, (40, 40), flags=cube.flags)
    values = np.concatenate([block.values for block in blocks])
    assert np.isfinite(values).any()
    assert_rounded_alike(values, np.concatenate([b.sigma for b in blocks]), whole.values)
    monkeypatch.setattr(streaming, "ASKEW_BYTES", streaming.BUFFER_BYTES)
    with pytest.raises(streaming.ScanRefused, match="tilted relative to the grid"):
        next(streaming.resample_scan(scan, maps, (40, 40), spool=tmp_path).blocks)


@pytest.mark.parametrize("step", [1, 7, 64, 1000])
def test_rows_are_written_as_the_whole_is(tmp_path, step):
    rng = np.random.default_rng(5)
    shape = (150, 90, 12)
    values = rng.uniform(0, 1, shape).astype(np.float32)
    flags = (rng.random(shape) < 0.01).astype(np.uint8)
    bands = tuple(Band(f"{w} nm", float(w)) for w in range(400, 1000, 50))
    cube = Cube(values, flags, (values / 50).astype(np.float32), bands, "reflectance")
    layer = Layer("icon", "v10")
    write_layer(tmp_path / "whole", layer, cube)
    blocks = [
        Cube(
            values[y : y + step],
            flags[y : y + step],
            cube.sigma[y : y + step],
            bands,
            "reflectance",
        )
        for y in range(0, shape[0], step)
    ]
    rows = CubeRows(blocks, shape, bands, "reflectance", has_sigma=True)
    entry, files = write_layer(tmp_path / "rows", layer, rows)
    assert hash_tree(tmp_path / "rows") == hash_tree(tmp_path / "whole")
    assert entry.bands == 12 and all(path.is_file() for path in files)


def test_the_count_that_is_shown_as_white_is_stated_in_the_file(tmp_path):
    values = np.full((50, 50, 1), 3000, np.float32)
    values[:25] = 30
    cube = Cube(values, np.zeros(values.shape, np.uint8), None, (Band("xray"),), "counts")
    _, files = write_layer(tmp_path, Layer("icon", "x"), cube)
    _, _, rgb, text = read_stiff(files[0])
    assert rgb[40, 0].tolist() == [255, 255, 255]
    assert json.loads(text)["rendering"] == "greyscale: xray; counts, 3000 shown as white"


@pytest.fixture(scope="module")
def registers():
    """`register_capture`, which gives what it gave before for the same pictures: they take longest."""
    real, known = register.register_capture, {}

    def registered(native, *rest):
        pictures = [(i.label, i.values.tobytes(), i.valid.tobytes()) for i in native.images()]
        key = hash(tuple(pictures))
        if key not in known:
            known[key] = real(native, *rest)
        return known[key]

    return registered


@pytest.mark.slow
@pytest.mark.parametrize(
    ("white", "tiles"),
    [(True, ("", "23")), pytest.param(False, ("", "23", "whole"), marks=pytest.mark.exhaustive)],
    ids=["reflectance", "counts"],
)
def test_a_streamed_scan_is_built_to_the_same_bytes_by_any_rows(
    small_scan, tmp_path, monkeypatch, registers, white, tiles
):
    monkeypatch.setattr(register, "register_capture", registers)
    campaign = tmp_path / "campaign"
    shutil.copytree(small_scan, campaign)
    text = (campaign / "campaign.toml").read_text() + "[database]\nnative = true\n"
    (campaign / "campaign.toml").write_text(text)
    if not white:
        lines = [line for line in text.splitlines() if not line.startswith("white")]
        (campaign / "campaign.toml").write_text("\n".join(lines))
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    monkeypatch.setattr(streaming, "BUFFER_BYTES", 3_000_000)
    trees = []
    for tile in tiles:
        monkeypatch.setenv("LEVKAS_TILE", tile)
        report = summarise(build(campaign, output=tmp_path / f"database{tile}"))
        assert report.ok, report.text
        trees.append(hash_tree(tmp_path / f"database{tile}"))
    assert all(tree == trees[0] for tree in trees[1:])
    assert any("v10" in name and "native" in name for name in trees[0])


def test_a_full_disk_is_foreseen_before_a_stage_writes(small_scan, tmp_path, monkeypatch):
    monkeypatch.setattr(disk, "_free_bytes", lambda folder: 50_000)
    report = summarise(build(small_scan, output=tmp_path / "database"))
    first = report.problems[0]
    assert first.code == "E_DISK_FULL" and first.found == "50000 bytes free"
    assert int(str(first.expected).split()[0]) > 100_000
    assert not list((tmp_path / "database").rglob("*.tif"))


KEYS = """
[campaign]
reference = "scan"
[cameras.scan]
kind = "cube"
files = "{target}*.hdr"
MORE
[targets]
DARK
WHITE
objects = ["panel"]
"""


def write_scan(folder, cubes, more=""):
    """Write dark, white and panel, (lines, samples, bands) of any type, as ENVI files; return the scan calibrated."""
    for name, cube in cubes.items():
        lines, samples, bands = cube.shape
        (folder / f"{name}.raw").write_bytes(cube.transpose(0, 2, 1).tobytes())
        (folder / f"{name}.hdr").write_text(
            f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
            f"data type = {12 if cube.dtype == np.uint16 else 4}\nbyte order = 0\n"
            f"wavelength = {{{', '.join(str(400 + 8 * b) for b in range(bands))}}}\n"
        )
    said = {"DARK": 'dark = "dark"', "WHITE": 'white = { names = "white", reflectance = 0.9 }'}
    text = KEYS.replace("MORE", more)
    for name, line in said.items():
        text = text.replace(name, line if name.lower() in cubes else "")
    (folder / "campaign.toml").write_text(text)
    return developed(folder)


def developed(folder):
    campaign = load_campaign(folder)
    (capture,), _ = find_captures(campaign)
    return develop(capture, campaign, TemplateCache(folder))


def levels(dtype, shape=(30, 20, 5)):
    rng = np.random.default_rng(2)
    known = {"dark": 100, "white": 3100, "panel": 1600}
    return {n: rng.normal(v, 5, shape).round().astype(dtype) for n, v in known.items()}


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
@pytest.mark.parametrize("spoilt", [("panel",), ("white",), ("dark",), ("dark", "white", "panel")])
def test_values_that_are_no_numbers_are_flagged_and_counted(tmp_path, monkeypatch, dtype, spoilt):
    cubes = levels(dtype)
    for number, name in enumerate(spoilt):
        cubes[name] = cubes[name].astype(np.float32) if name != "panel" else cubes[name]
        if cubes[name].dtype.kind == "f":
            cubes[name][4, 3 + number, 2] = [np.nan, np.inf, -np.inf][number]
    monkeypatch.setenv("LEVKAS_TILE", "7")
    native = write_scan(tmp_path, cubes)
    expected = np.zeros((30, 20, 5), bool)
    for number, name in enumerate(spoilt):
        if cubes[name].dtype.kind == "f":
            expected[4 if name == "panel" else slice(None), 3 + number, 2] = True
    cube = native.cubes[""]
    lost = cube.flags & (Flag.DEFECT | Flag.OUTSIDE) == Flag.DEFECT | Flag.OUTSIDE
    assert np.array_equal(lost, expected)
    assert (cube.values[lost] == 0).all() and np.isfinite(cube.values).all()
    counted = [w for w in native.warnings if "finite number" in w]
    assert len(counted) == expected.any()
    assert not counted or f"scan: {lost.sum()} value" in counted[0]


def test_a_band_of_a_scan_without_a_finite_value_is_refused(tmp_path):
    cubes = levels(np.float32)
    cubes["panel"][..., 3] = np.nan
    with pytest.raises(CalibrationRefused, match=r"band 4.*no finite value") as refused:
        write_scan(tmp_path, cubes)
    assert "panel.hdr" in refused.value.problems[0].file


def test_strips_are_calibrated_and_joined(tmp_path):
    rng = np.random.default_rng(5)
    paint = np.kron(rng.uniform(0.1, 0.8, (12, 20, 5)), np.ones((5, 5, 1)))
    cubes = levels(np.uint16, (60, 60, 5))
    whole = (100 + 3000 * paint / 0.9 + rng.normal(0, 4, paint.shape)).round().astype(np.uint16)
    del cubes["panel"]
    cubes |= {"panel_1": whole[:, :60], "panel_2": whole[:, 40:]}
    native = write_scan(tmp_path, cubes)
    assert native.cubes[""].values.shape == paint.shape
    assert np.abs(native.cubes[""].values - paint).max() < 0.02
    assert any("share 20.00 samples (shift 0.00 lines" in text for text in native.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("more", ["", 'scan = "mirror"\n'], ids=["push-broom", "mirror"])
def test_hysime_takes_away_the_same_noise_in_any_lines(tmp_path, monkeypatch, more):
    rng, at = np.random.default_rng(3), np.linspace(0, 1, 60)
    spectra = np.array([np.exp(-(((at - c) / 0.15) ** 2)) + 0.1 for c in np.linspace(0, 1, 5)])
    signal = 3000 * rng.dirichlet(np.full(5, 0.5), (40, 50)) @ spectra
    cubes = levels(np.uint16, (40, 50, 60))
    cubes["panel"] = (100 + signal + rng.normal(0, 8, signal.shape)).round().astype(np.uint16)
    cubes["white"] = cubes["white"].astype(np.float32)
    cubes["white"][0, 9, 9] = np.nan
    monkeypatch.setenv("LEVKAS_TILE", "7")
    found = write_scan(tmp_path, cubes, more + 'denoise = "hysime"')
    monkeypatch.setenv("LEVKAS_TILE", "whole")
    whole = developed(tmp_path)
    assert same(found.cubes[""], whole.cubes[""])
    assert found.warnings == whole.warnings
    assert any("hysime kept 5 of 60" in text for text in found.warnings)


MIRROR = 'scan = "mirror"'


def behind_a_mirror(rng, shape=(90, 60, 6), gain=0.4, read=3.0):
    """Return cubes whose dark and white change from line to line, as a mirror sees them."""
    line, sample, band = (np.linspace(-1, 1, n) for n in shape)
    board = np.exp(-((line[:, None] - 0.2) ** 2) - 0.5 * (sample + 0.3 * line[:, None]) ** 2)
    response = 1 + 0.012 * rng.standard_normal(shape[1:])
    light = 9000 * board[..., None] * (0.6 + 0.4 * np.cos(band)) * response
    under = 100 + 10 * line[:, None, None] + rng.normal(0, 4, shape[1:])
    paint = np.kron(rng.uniform(0.1, 0.8, (9, 6, 6)), np.ones((10, 10, 1)))
    lit = {"dark": 0 * light, "white": light, "panel": paint / 0.9 * light}
    noisy = {n: gain * rng.poisson(e) + under + rng.normal(0, read, shape) for n, e in lit.items()}
    return {n: c.round().clip(0).astype(np.uint16) for n, c in noisy.items()}, paint


@pytest.mark.parametrize("most", [2_000_000, 8000])  # all samples, every second
def test_a_mirror_scan_is_as_exact_as_its_sigma_says(tmp_path, monkeypatch, most):
    monkeypatch.setattr(scan_templates, "MOST_VALUES", most)
    cubes, paint = behind_a_mirror(np.random.default_rng(7))
    native = write_scan(tmp_path, cubes, MIRROR)
    cube, record = native.cubes[""], native.measured[""]["sensor"]
    assert record["gain"] == pytest.approx(0.4, rel=0.05)
    assert record["read_noise"] == pytest.approx(3.0, rel=0.05)
    pull = (cube.values - paint)[cube.flags == 0] / cube.sigma[cube.flags == 0]
    assert abs(pull.mean()) < 0.03 and pull.std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("tile", ["1", "7"])
def test_lines_of_a_mirror_scan_do_not_depend_on_those_taken_together(tmp_path, monkeypatch, tile):
    cubes, _ = behind_a_mirror(np.random.default_rng(8))
    cubes["panel"][20:24, 5:9, 2] = 65535
    monkeypatch.setenv("LEVKAS_TILE", tile)
    found = write_scan(tmp_path, cubes, MIRROR)
    monkeypatch.setenv("LEVKAS_TILE", "whole")
    whole = developed(tmp_path)
    assert same(found.cubes[""], whole.cubes[""])
    assert found.warnings == whole.warnings and found.measured == whole.measured


@pytest.mark.parametrize("missing", ["dark", "white"])
def test_a_mirror_scan_may_be_without_dark_or_white(tmp_path, missing):
    cubes, paint = behind_a_mirror(np.random.default_rng(9))
    del cubes[missing]
    native = write_scan(tmp_path, cubes, MIRROR)
    cube = native.cubes[""]
    if missing == "white":
        assert cube.sigma is None and native.quantity == "counts"
        assert np.abs(cube.values.mean() - (cubes["panel"].mean() - cubes["dark"].mean())) < 0.1
    else:
        assert native.quantity == "reflectance" and np.median(np.abs(cube.values - paint)) < 0.05


@pytest.mark.parametrize("spoilt", [("panel",), ("white",), ("dark",), ("dark", "white", "panel")])
def test_values_of_a_mirror_scan_that_are_no_numbers_are_flagged(tmp_path, monkeypatch, spoilt):
    cubes, _ = behind_a_mirror(np.random.default_rng(10))
    cubes = {name: cube.astype(np.float32) for name, cube in cubes.items()}
    for number, name in enumerate(spoilt):
        cubes[name][40, 30 + number, 2] = [np.nan, np.inf, -np.inf][number]
    monkeypatch.setenv("LEVKAS_TILE", "7")
    native = write_scan(tmp_path, cubes, MIRROR + "\nsaturation = 65535")
    assert any(f"{len(spoilt)} value" in text for text in native.warnings)
    lost = native.cubes[""].flags & (Flag.DEFECT | Flag.OUTSIDE) == Flag.DEFECT | Flag.OUTSIDE
    assert lost.sum() == len(spoilt) and lost[40, 30 : 30 + len(spoilt), 2].all()
    record = native.measured[""]["sensor"]
    assert record["gain"] == pytest.approx(0.4, rel=0.06) and np.isfinite(record["read_noise"])


def darker(cubes):
    cubes["white"], cubes["dark"] = cubes["dark"], cubes["white"]


def clipped(cubes):
    cubes["white"][:60] = 65535


def shorter(cubes):
    cubes["white"] = cubes["white"][:-1]


def narrower(cubes):
    cubes["dark"] = cubes["dark"][:, 1:]


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (darker, "E_WHITE_DARK"),
        (clipped, "E_WHITE_SATURATED"),
        (shorter, "E_SIZE"),
        (narrower, "E_SIZE"),
    ],
)
def test_templates_of_a_mirror_scan_that_cannot_serve_are_refused(tmp_path, spoil, code):
    cubes, _ = behind_a_mirror(np.random.default_rng(11))
    spoil(cubes)
    with pytest.raises(CalibrationRefused) as refused:
        write_scan(tmp_path, cubes, MIRROR)
    assert refused.value.problems[0].code == code


def test_a_mirror_scan_counts_three_times_and_needs_envi_templates(tmp_path, monkeypatch):
    cubes, _ = behind_a_mirror(np.random.default_rng(12))
    write_scan(tmp_path, cubes, MIRROR)
    text = (tmp_path / "campaign.toml").read_text()
    other = '[cameras.photo]\nkind = "image"\nfiles = "{target}.png"\n[targets]'
    text = text.replace("[targets]", other).replace('reference = "scan"', 'reference = "photo"')
    (tmp_path / "campaign.toml").write_text(text)
    tifffile.imwrite(tmp_path / "panel.png", cubes["panel"][..., 0])
    campaign = load_campaign(tmp_path)
    capture = next(c for c in find_captures(campaign)[0] if c.camera == "scan")
    size = cubes["panel"].size
    for most, streamed in ((3 * size - 1, True), (3 * size, False)):
        monkeypatch.setattr(scans, "STREAMED_SAMPLES", most)
        assert is_streamed(capture, campaign) == streamed
