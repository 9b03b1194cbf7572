"""A beam-splitter camera whose sensors are demosaiced by weights for their own channels."""

import numpy as np
import pytest
import tifffile

from levkas.building import build, summarise
from levkas.calibration.mosaic import demosaic
from levkas.calibration.wiener_mosaic import correlate_channels, wiener_method
from levkas.core.problems import Refused

SHAPE = (64, 72)
CENTRES = {"R1": 620, "G1": 548, "B1": 482, "R2": 588, "G2": 512, "B2": 440}
KEYS = """
[campaign]
reference = { camera = "split", band = "G1" }
[database]
native = true
[cameras.split]
kind = "sensors"
files = "{target}_{sensor}_{shot}.tif"
demosaic = "wiener"
sensitivity = "split.csv"
bits = 12
[[cameras.split.sensors]]
name = "a"
pattern = [["R1", "G1"], ["G1", "B1"]]
[[cameras.split.sensors]]
name = "b"
pattern = [["R2", "G2"], ["G2", "B2"]]
align = [[1, 0, 0], [0, 1, 0]]
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.9 }
objects = ["panel"]
"""


def sensitivities(folder, width=18.0, names=tuple(CENTRES)):
    nm = np.arange(400.0, 701.0, 5.0)
    curves = [np.exp(-0.5 * ((nm - CENTRES[name]) / width) ** 2) for name in names]
    table = np.column_stack([nm, *curves])
    head = ",".join(("wavelength", *names))
    np.savetxt(folder / "split.csv", table, delimiter=",", header=head, comments="")
    return nm, np.stack(curves, 1)


@pytest.fixture
def campaign(tmp_path):
    rng = np.random.default_rng(0)
    sensitivities(tmp_path)
    paint = np.kron(rng.uniform(0.1, 0.8, (16, 18)), np.ones((4, 4)))
    for sensor in "ab":
        for target, level in (("dark", 0 * paint), ("white", 0 * paint + 0.9), ("panel", paint)):
            for shot in (1, 2):
                codes = 60 + 3000 * level + rng.normal(0, 4, SHAPE)
                path = tmp_path / f"{target}_{sensor}_{shot}.tif"
                tifffile.imwrite(path, codes.round().clip(0, 4095).astype(np.uint16))
    (tmp_path / "campaign.toml").write_text(KEYS)
    return tmp_path


def calibrated(campaign):
    """Build, and return the state of the calibration; so small a picture may not register."""
    stages = summarise(build(campaign)).stages
    return next(step.state for step in stages if step.key.stage == "calibrate")


@pytest.mark.slow
def test_each_sensor_has_the_weights_of_its_own_channels(campaign):
    assert calibrated(campaign) == "done"
    native = campaign / "database" / "objects" / "panel" / "native"
    wavelengths, curves = sensitivities(campaign)
    for number, sensor in enumerate("ab"):
        (path,) = [p for p in native.glob(f"*_{sensor}.tif")]
        made = np.moveaxis(tifffile.imread(path), 0, -1)
        y, x = np.indices(SHAPE)
        which = np.array([[0, 1], [1, 2]])[y % 2, x % 2]
        observed = np.take_along_axis(made, which[..., None], 2)[..., 0]
        own = wiener_method(correlate_channels(wavelengths, curves[:, 3 * number : 3 * number + 3]))
        none = np.zeros(SHAPE, np.uint8)
        wanted, _, _ = demosaic(observed, none, None, [["R", "G"], ["G", "B"]], method=own)
        # Stored values are rounded to a share of their sigma.
        assert np.abs(made - wanted).max() < 2e-3
        other, _, _ = demosaic(observed, none, None, [["R", "G"], ["G", "B"]], method="bilinear")
        assert np.abs(made - other).max() > 0.02


@pytest.mark.slow
def test_other_sensitivities_make_the_layer_stale(campaign):
    calibrated(campaign)
    assert calibrated(campaign) == "fresh"
    sensitivities(campaign, width=30.0)
    assert calibrated(campaign) == "done"


@pytest.mark.parametrize(
    "spoil, message",
    [
        (
            lambda f, t: t.replace('sensitivity = "split.csv"\n', ""),
            "follow from its sensitivities",
        ),
        (lambda f, t: sensitivities(f, names=("R1", "G1")) and t, "do not match the channels"),
        (
            lambda f, t: (f / "split.csv").write_text("wavelength,R1\nnm,none\n") and t,
            "cannot be read",
        ),
        (lambda f, t: t.replace('"wiener"', '"viener"'), "viener"),
    ],
    ids=["no table", "other channels", "no numbers", "misspelt"],
)
def test_what_cannot_give_weights_is_refused(campaign, spoil, message):
    text = spoil(campaign, (campaign / "campaign.toml").read_text())
    (campaign / "campaign.toml").write_text(text)
    try:
        problems = summarise(build(campaign)).problems
    except Refused as refused:
        problems = refused.problems
    assert any(message in str(problem) for problem in problems), problems
    assert not (campaign / "database/objects/panel/panel_split.tif").exists()
