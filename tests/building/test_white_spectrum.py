"""A white board that is not the same at every wavelength, seen by channels of known and unknown sensitivity."""

import numpy as np
import pytest
import tifffile

from levkas.building import build, status, summarise
from levkas.database.spectral_tiff import read_tiff_pages

SHAPE, FULL = (120, 160), 3000.0
NM = np.arange(380.0, 721.0, 5.0)
BOARD = np.interp(NM, [400, 700], [0.80, 0.95])
LAMP = np.interp(NM, [380, 720], [0.1, 1.0])
"""Rising like an incandescent lamp."""
CURVES = np.exp(-(((NM[:, None] - np.array([600.0, 540.0, 455.0])) / 45.0) ** 2))
KEYS = """
[campaign]
reference = "rgb"
[cameras.rgb]
kind = "mosaic"
pattern = "GBRG"
files = "raw/{target}_{shot}.tif"
bits = 12
sensitivity = "rgb.csv"
[targets]
dark = "dark"
white = { names = "white", reflectance = "white.csv" }
objects = ["panel"]
[setups.default]
spectrum = "lamp.csv"
"""


def write_tables(folder):
    for name, table, head in (
        ("rgb", CURVES, "wavelength,R,G,B"),
        ("white", BOARD[:, None], "wavelength,board"),
        ("lamp", LAMP[:, None], "wavelength,power"),
    ):
        rows = [",".join(f"{v:.6f}" for v in row) for row in np.column_stack([NM, table])]
        (folder / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A paint of 0.50 at every wavelength, and blocks that registration can hold on to."""
    folder, rng = tmp_path_factory.mktemp("board"), np.random.default_rng(1)
    (folder / "raw").mkdir()
    write_tables(folder)
    observed = CURVES * LAMP[:, None]
    white = BOARD @ observed / observed.sum(0)
    y, x = np.indices(SHAPE)
    channel = np.array([[1, 2], [0, 1]])[y % 2, x % 2]
    blocks = np.kron(rng.uniform(0.1, 0.9, (6, 8)), np.ones((20, 20)))
    paint = np.where((y > 40) & (y < 80), 0.5, blocks)
    for name, scene, count in (("dark", 0.0, 4), ("white", white[channel], 4), ("panel", paint, 2)):
        level = FULL * np.broadcast_to(scene, SHAPE)
        for shot in range(count):
            noisy = 60 + level + np.sqrt(4 + 0.2 * level) * rng.standard_normal(SHAPE)
            codes = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
            tifffile.imwrite(folder / "raw" / f"{name}_{shot}.tif", codes)
    return folder


def paint_of(folder, keys):
    (folder / "campaign.toml").write_text(keys)
    report = summarise(build(folder))
    assert report.ok, report.problems
    values = read_tiff_pages(folder / "database/objects/panel/panel_rgb.tif")
    return values[45:75].mean((0, 1)), report.warnings


def test_the_white_is_weighted_by_sensitivity_and_light(campaign):
    paint, warnings = paint_of(campaign, KEYS)
    np.testing.assert_allclose(paint, 0.5, rtol=0.003)  # red, green, blue, though green comes first
    assert not any("not the same at every wavelength" in w for w in warnings)
    # another light is another white
    (campaign / "lamp.csv").write_text("nm,power\n380,1\n720,0.1\n")
    stale = {s.key.stage for s in status(campaign).stages if s.state == "stale"}
    assert "calibrate" in stale
    write_tables(campaign)


def test_without_sensitivities_the_possible_error_is_stated(campaign):
    paint, warnings = paint_of(campaign, KEYS.replace('sensitivity = "rgb.csv"\n', ""))
    worst = np.abs(paint / 0.5 - 1).max()
    (note,) = [w for w in warnings if "not the same at every wavelength" in w]
    assert "R, G, B" in note and "up to 8.6 %" in note and "sensitivity" in note
    assert 0.02 < worst < 0.086


def test_a_board_that_is_not_known_where_a_channel_sees_is_named(campaign):
    (campaign / "white.csv").write_text("nm,board\n480,0.9\n700,0.9\n")
    _, warnings = paint_of(campaign, KEYS)
    write_tables(campaign)
    (note,) = [w for w in warnings if "covers" in w]
    assert "G, B" in note or "B: " in note
