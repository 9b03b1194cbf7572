"""Whole builds of cameras whose lines are displaced."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from levkas.building import build
from levkas.geometry import from_dict

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
    evidence = {c: v["numbers"]["sensor"] for c, v in verdicts.items()}
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
