"""Whole builds of cameras whose lines are displaced."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from levkas.building import build

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


def seen(surface, matrix=((1.0, 0, 0), (0, 1, 0)), size=SIZE, shift=0.0, noise=0.003):
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


@pytest.fixture(scope="module")
def lines_built(tmp_path_factory):
    """A photograph, two scans of which one wobbles by ±1 px every 40 lines, and interlaced halves 2 px apart."""
    folder, surface = tmp_path_factory.mktemp("lines"), painting()
    line = np.arange(SIZE[1])[:, None]
    grey = seen(surface)
    write_picture(folder / "photo/panel.tif", np.dstack([grey, grey, grey]))
    askew = ((1.0, 0.01, 2.0), (-0.01, 1.0, 3.0))
    write_scan(folder / "still/panel.hdr", seen(surface, askew))
    wobble = np.sin(2 * np.pi * line / 40)
    write_scan(folder / "wobbling/panel.hdr", seen(surface, askew, shift=wobble))
    write_picture(folder / "video/panel.tif", seen(surface, askew, shift=2.0 * (line % 2)))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    list(build(folder, output=folder / "database"))
    return folder / "database"


def test_a_wobbling_scan_and_interlaced_halves_are_doubtful_in_a_build(lines_built):
    verdicts = {c: record_of(lines_built, c)["verdict"] for c in ("still", "wobbling", "video")}
    assert [v["decision"] for v in verdicts.values()] == ["accept", "warn", "warn"]
    evidence = {c: v["numbers"]["sensor"]["borne_out"] for c, v in verdicts.items()}
    found = {c: one["line_displacement"] for c, one in evidence.items()}
    assert found["still"]["course"] is None
    assert (found["wobbling"]["course"], found["wobbling"]["lines"]) == ("period", "rows")
    assert found["wobbling"]["period_lines"] == pytest.approx(40, rel=0.03)
    assert found["wobbling"]["size_px"] == pytest.approx(1.0, rel=0.12)
    assert (found["video"]["course"], found["video"]["period_lines"]) == ("comb", 2.0)
    assert found["video"]["size_px"] == pytest.approx(2.0, rel=0.08)
    assert verdicts["video"]["reasons"][0].startswith("Odd and even lines of this picture lie")


def test_the_report_shows_the_displacement_of_lines(lines_built):
    report = (lines_built / "objects/panel/report.html").read_text(encoding="utf-8")
    assert report.count("Displacement of single lines") == 2
    assert "every 40 lines" in report
