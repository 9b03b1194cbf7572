"""Whole builds of cameras whose lines are displaced, and of sensors with a declared alignment."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from levkas.building import build
from levkas.building.plan import read_plan
from levkas.database.layout import Places
from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine
from levkas.stages import scans, tiles
from levkas.stages.calibrate import load_calibrated
from levkas.stages.streaming import ScanRefused

pytestmark = pytest.mark.slow
SIZE, MARGIN = (300, 230), 60
CAMPAIGN = """
[campaign]
title = "lines and sensors"
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.tif"
[cameras.still]
kind = "cube"
files = "still/{target}.hdr"
[cameras.wobbling]
kind = "cube"
files = "wobbling/{target}.hdr"
[cameras.video]
kind = "image"
files = "video/{target}.tif"
[targets]
objects = ["panel"]
"""
SENSORS = """
[cameras.NAME]
kind = "sensors"
bits = 16
[[cameras.NAME.sensors]]
name = "near"
files = "near/{target}.tif"
[[cameras.NAME.sensors]]
name = "far"
files = "FAR/{target}.tif"
"""


def painting():
    """Return strokes of several sizes, (h, w), `MARGIN` px wider than the reference on each side."""
    rng = np.random.default_rng(8)
    shape = (SIZE[1] + 2 * MARGIN, SIZE[0] + 2 * MARGIN)
    strokes = [ndimage.gaussian_filter(rng.normal(size=shape), (s, 2 * s)) for s in (1, 2.5, 6)]
    total = sum(stroke / stroke.std() for stroke in strokes)
    return 0.45 + 0.08 * ndimage.gaussian_filter(total, 0.7)


def observed(surface, matrix=((1.0, 0, 0), (0, 1, 0)), size=SIZE, shift=0.0, noise=0.003):
    """Return counts of a camera whose px x lies at `matrix` · x of the reference, lines moved by `shift`, (lines, 1) px."""
    x, y = np.meshgrid(np.arange(float(size[0])), np.arange(float(size[1])))
    matrix = np.array(matrix)
    places = np.stack([(x + shift).ravel(), y.ravel()], 1) @ matrix[:, :2].T + matrix[:, 2]
    values = ndimage.map_coordinates(surface, places.T[::-1] + MARGIN, order=3, mode="nearest")
    values = values.reshape(size[::-1]) + np.random.default_rng(4).normal(0, noise, size[::-1])
    return np.rint(np.clip(values, 0, 1) * 40_000).astype(np.uint16)


def write_scan(path, lines):
    """Write an ENVI cube, BIL, of two bands."""
    path.parent.mkdir(parents=True)
    path.with_suffix(".raw").write_bytes(np.stack([lines, lines // 2], 1).astype("<u2").tobytes())
    path.write_text(
        f"ENVI\nsamples = {lines.shape[1]}\nlines = {lines.shape[0]}\nbands = 2\ndata type = 12\n"
        "interleave = bil\nbyte order = 0\nheader offset = 0\nwavelength = {550, 650}\n"
    )


def write_picture(path, counts):
    path.parent.mkdir(parents=True)
    tifffile.imwrite(path, counts)


def record_of(database: Path, camera: str) -> dict:
    return json.loads((database / f"objects/panel/registration/{camera}.json").read_text())


ASKEW = ((1.0, 0.01, 2.0), (-0.01, 1.0, 3.0))


@pytest.fixture(scope="module")
def lines_built(tmp_path_factory):
    """A photograph, two scans of which one wobbles by ±1 px every 40 lines, and interlaced halves 2 px apart."""
    folder, surface = tmp_path_factory.mktemp("lines"), painting()
    line = np.arange(SIZE[1])[:, None]
    grey = observed(surface)
    write_picture(folder / "photo/panel.tif", np.dstack([grey, grey, grey]))
    write_scan(folder / "still/panel.hdr", observed(surface, ASKEW))
    wobble = np.sin(2 * np.pi * line / 40)
    write_scan(folder / "wobbling/panel.hdr", observed(surface, ASKEW, shift=wobble))
    write_picture(folder / "video/panel.tif", observed(surface, ASKEW, shift=2.0 * (line % 2)))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    list(build(folder, output=folder / "database"))
    return folder / "database"


def test_maps_follow_a_wobbling_scan_and_interlaced_halves_in_a_build(lines_built):
    verdicts = {c: record_of(lines_built, c)["verdict"] for c in ("still", "wobbling", "video")}
    assert [v["decision"] for v in verdicts.values()] == ["accept", "accept", "warn"]
    evidence = {c: v["numbers"]["sensor"]["verification"] for c, v in verdicts.items()}
    assert not evidence["still"]["line_displacement"]["displaced"]
    assert evidence["still"]["line_correction"] is None
    found = {c: evidence[c]["line_correction"]["before"] for c in ("wobbling", "video")}
    assert {one["lines"] for one in found.values()} == {"rows"}
    assert found["wobbling"]["rms_px"] == pytest.approx(1 / 2**0.5, rel=0.12)
    assert found["video"]["rms_px"] == pytest.approx(1.0, rel=0.08)


def test_maps_of_displaced_lines_lie_right_in_a_build(lines_built):
    """Every pixel of a scan is put to within a tenth of what it shows, the mean over all lines but those at the rim."""
    line = np.arange(SIZE[1])
    wobbles = {"wobbling": np.sin(2 * np.pi * line / 40), "video": 2.0 * (line % 2)}
    for camera, wobble in wobbles.items():
        bands = record_of(lines_built, camera)["bands"]
        map_ = from_dict(next(iter(bands.values()))["transform"])
        x, y = np.meshgrid(np.arange(20, SIZE[0] - 20, 5.0), np.arange(20, SIZE[1] - 20, 1.0))
        places = np.stack([x.ravel(), y.ravel()], 1)
        shift = np.stack([wobble[places[:, 1].astype(int)], 0 * places[:, 1]], 1)
        askew = np.array(ASKEW)
        shown = (places + shift) @ askew[:, :2].T + askew[:, 2]
        errors = np.linalg.norm(map_.inverse(places) - shown, axis=1)
        assert errors.mean() < 0.1, camera


def test_the_report_shows_the_displacement_of_lines(lines_built):
    report = (lines_built / "objects/panel/report.html").read_text(encoding="utf-8")
    assert report.count("Displacement of single lines") == 2


# --- passes of a scanner that wobble each by itself


STRIPS = {"c1": (0.0, 1.5, 60, 0.3), "c2": (130.4, 0.5, 100, 2.0)}
"""First px in the reference; amplitude, px, period, lines, and phase of the wobble."""


def wobble_of(strip, line):
    _, size, period, phase = STRIPS[strip]
    return size * np.sin(2 * np.pi * line / period + phase)


@pytest.fixture(scope="module")
def strips_built(tmp_path_factory):
    """A photograph and two passes of a scanner that share 40 px; ±1.5 px every 60 lines, ±0.5 px every 100."""
    folder, surface = tmp_path_factory.mktemp("strips"), painting()
    grey, lines = observed(surface), np.arange(SIZE[1])[:, None]
    write_picture(folder / "photo/panel.tif", np.dstack([grey, grey, grey]))
    for name, (first, *_) in STRIPS.items():
        askew = np.add(ASKEW, ((0, 0, first), (0, 0, 0)))
        counts = observed(surface, askew, (170, SIZE[1]), shift=wobble_of(name, lines))
        write_scan(folder / f"scan/{name}/panel.hdr", counts)
    text = CAMPAIGN.partition("[cameras.still]")[0] + '[targets]\nobjects = ["panel"]\n'
    text += '[cameras.scan]\nkind = "cube"\nfiles = "scan/c{column}/{target}.hdr"\n'
    text += "[database]\nnative = true\n"
    (folder / "campaign.toml").write_text(text)
    list(build(folder, output=folder / "database"))
    return folder / "database"


def test_passes_that_wobble_each_by_itself_are_followed(strips_built):
    """Pixels of both passes lie to within a tenth of what they show, the mean of all but the outermost lines."""
    record = record_of(strips_built, "scan")
    assert record["verdict"]["decision"] == "accept"
    for name, (first, *_) in STRIPS.items():
        bands = record["tiles"][name]["bands"]
        x, y = np.meshgrid(np.arange(8, 162, 5.0), np.arange(12, SIZE[1] - 12, 1.0))
        pixels = np.stack([x.ravel(), y.ravel()], 1)
        moved = pixels + np.stack([wobble_of(name, pixels[:, 1]), 0 * pixels[:, 1]], 1)
        shown = moved @ np.array(ASKEW)[:, :2].T + np.array(ASKEW)[:, 2] + (first, 0)
        for band in bands.values():
            errors = np.linalg.norm(from_dict(band["transform"])(shown) - pixels, axis=1)
            assert errors.mean() < 0.1, (name, errors.mean())


def test_large_passes_are_streamed_to_the_same_bytes(strips_built, tmp_path, monkeypatch):
    """Without whole passes in memory; where pictures would be too large, registration sees means of blocks."""
    folder = strips_built.parent
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    list(build(folder, output=tmp_path / "streamed"))
    paths = sorted((strips_built / "objects/panel").rglob("panel_scan*.tif"))
    assert len(paths) >= 6  # values and flags of the layer and of two passes
    for path in paths:
        streamed = tmp_path / "streamed" / path.relative_to(strips_built)
        assert path.read_bytes() == streamed.read_bytes(), path.name
    plan = read_plan(folder)
    (capture,) = [one for one in plan.captures if one.camera == "scan"]
    native = load_calibrated(capture, plan.campaign, Places(strips_built), {}, None)
    whole, factor = native.pictures("c1")
    assert factor == 1
    monkeypatch.setattr(scans, "LOOKED_AT_PX", 170 * SIZE[1] / 4)
    means, factor = native.pictures("c1")
    assert factor == 2
    blocks = native.pages("c1", "")[0].read(0, SIZE[1]).reshape(SIZE[1] // 2, 2, 85, 2, 2)
    for band, one in enumerate(means):
        assert one.label == whole[band].label
        np.testing.assert_allclose(one.values, blocks[..., band].mean((1, 3)), rtol=1e-5)


def test_large_passes_across_the_grid_are_refused(strips_built, monkeypatch):
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    plan = read_plan(strips_built.parent)
    (capture,) = [one for one in plan.captures if one.camera == "scan"]
    native = load_calibrated(capture, plan.campaign, Places(strips_built), {}, None)
    maps = {band.label: Affine.identity() for band in native.bands}
    across = {b: Affine(np.array([[0.0, 1, 0], [1, 0, 0]])) for b in maps}
    held = tiles.MOST_ROWS * 1.2 * 170 * 2 * 9  # bytes of the lines that rows of the grid need
    monkeypatch.setattr(tiles, "ASKEW_BYTES", held)
    native.on_grid(maps, SIZE)
    with pytest.raises(ScanRefused, match="tile c1 is tilted relative to the grid"):
        native.on_grid(across, SIZE[::-1])


# --- sensors with a declared alignment


def turned(degrees, scale):
    """Return px of the first sensor → px of a small sensor about the same middle, and its size."""
    angle, size = np.deg2rad(degrees), np.round(np.array(SIZE) * scale).astype(int)
    rows = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = (np.array(SIZE) - 1) / 2
    return np.column_stack([rows, (size - 1) / 2 - rows @ middle]), tuple(size.tolist())


def inverse(matrix):
    back = np.linalg.inv(matrix[:, :2])
    return np.column_stack([back, -back @ matrix[:, 2]])


@pytest.fixture(scope="module")
def sensors_built(tmp_path_factory):
    """Cameras of two sensors; the second of some is turned, coarse and so noisy that no key points match."""
    folder, surface = tmp_path_factory.mktemp("sensors"), painting()
    grey = observed(surface)
    write_picture(folder / "photo/panel.tif", np.dstack([grey, grey, grey]))
    write_picture(folder / "near/panel.tif", observed(surface, noise=0.004))
    hard, size = turned(137, 0.3)
    write_picture(folder / "hard/panel.tif", observed(surface, inverse(hard), size, noise=0.11))
    easy = np.array([[1.0, 0.004, 3.0], [-0.004, 1.0, -2.0]])
    write_picture(folder / "easy/panel.tif", observed(surface, inverse(easy)))
    near = hard + np.array([[0, 0, 1.5], [0, 0, -1.0]])  # as exact as a person measures it
    wrong = easy + np.array([[0, 0, 100.0], [0, 0, 0]])
    tables = CAMPAIGN.partition("[cameras.still]")[0] + '[targets]\nobjects = ["panel"]\n'
    for name, far, align in (
        ("measured", "hard", None), ("declared", "hard", near), ("right", "easy", easy),
        ("wrong", "easy", wrong),
    ):  # fmt: skip
        tables += SENSORS.replace("NAME", name).replace("FAR", far)
        if align is not None:
            tables += f"align = {np.round(align, 6).tolist()}\n"
    (folder / "campaign.toml").write_text(tables)
    list(build(folder, output=folder / "database"))
    return folder / "database", {"hard": hard, "easy": easy}


def test_a_declared_alignment_registers_a_sensor_that_is_refused_without_it(sensors_built):
    database, truth = sensors_built
    refused = record_of(database, "measured")["verdict"]
    assert refused["decision"] == "refuse" and "align" in refused["next_step"]
    record = record_of(database, "declared")
    assert record["verdict"]["decision"] != "refuse"
    points = np.stack(np.meshgrid(np.arange(60, 240, 30.0), np.arange(50, 180, 30.0)), -1)
    points = points.reshape(-1, 2)
    found = from_dict(record["bands"]["far"]["transform"])(points)
    expected = points @ truth["hard"][:, :2].T + truth["hard"][:, 2]
    assert np.linalg.norm(found - expected, axis=1).mean() < 0.15
    assert record["verdict"]["numbers"]["far"]["align_apart_px"] == pytest.approx(1.8, abs=0.4)


def test_an_alignment_that_is_wrong_by_100_px_is_named_and_does_not_move_the_map(sensors_built):
    database, truth = sensors_built
    assert record_of(database, "right")["verdict"]["decision"] == "accept"
    record = record_of(database, "wrong")
    verdict = record["verdict"]
    assert verdict["decision"] == "warn"
    assert "sensor far: The sensor lies 100.0 of its px" in " ".join(verdict["reasons"])
    assert "align" in verdict["next_step"]
    points = np.array([[60.0, 50], [240, 60], [150, 180]])
    found = from_dict(record["bands"]["far"]["transform"])(points)
    expected = points @ truth["easy"][:, :2].T + truth["easy"][:, 2]
    np.testing.assert_allclose(found, expected, atol=0.1)
