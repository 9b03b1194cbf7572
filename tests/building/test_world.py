"""The one small world as it was built: maps and reflectance of five cameras are those that were drawn."""

import csv
import json

import numpy as np
import pytest

import levkas
from levkas.building import status
from levkas.core.digests import hash_file
from levkas.database.pixel_frames import map_points
from levkas.database.validation import validate

POINTS = np.stack(np.meshgrid(np.linspace(30, 300, 9), np.linspace(30, 250, 8)), -1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("frame", "share", "most"),
    [
        ("filters", 0.95, 0.08),
        ("colour", 0.95, 0.08),
        ("scan", 0.95, 0.1),
        ("xray#left", 0.6, 0.05),
        ("xray#right", 0.6, 0.05),
    ],
)
def test_maps_are_those_that_were_drawn(world, frame, share, most):
    there = map_points(world.database, "panel", POINTS, source="photo", target=frame)
    error = np.hypot(*(there - world.truth(POINTS, frame)).T)
    assert np.isfinite(error).mean() > share and np.nanmax(error) < most


@pytest.mark.parametrize("camera", ["filters", "colour", "scan"])
def test_reflectance_is_right_within_its_sigma_on_the_grid(world, camera):
    layer = levkas.open(world.database)["panel"][camera]
    truth = world.reflectance("photo")
    # Edges of patches lie between sensels: where the painting is even it shows the noise alone.
    even = np.hypot(*np.gradient(truth)) < 0.02
    for band in layer.band.values:
        miss = layer.sel(band=band).values - truth
        assert np.nanmedian(np.abs(miss)[even]) < 0.01
        good = even & (layer.levkas.flags.sel(band=band).values == 0)
        assert good.mean() > 0.1
        assert abs(np.median(miss[good])) < 0.003


def test_strips_and_tiles_are_one_layer_each(world):
    opened = levkas.open(world.database)["panel"]
    for camera in ("scan", "xray"):
        assert np.isfinite(opened[camera].values).mean() > 0.85
    record = json.loads((world.database / "objects/panel/registration/xray.json").read_text())
    assert len(record["tiles"]) == 2 and record["verdict"]["decision"] == "accept"


def test_all_is_fresh_listed_and_valid(world):
    assert {step.state for step in status(world.folder).stages} == {"fresh"}
    with (world.database / "catalogue.csv").open(newline="") as file:
        cameras = {row["camera"] for row in csv.DictReader(file)}
    assert cameras == {"photo", "filters", "colour", "scan", "xray"}
    assert validate(world.database).ok


def test_provenance_names_every_frame_with_its_role_and_hash(world):
    record = json.loads((world.database / "objects/panel/provenance.json").read_text())
    steps = {(s["camera"], s["stage"]): s for s in record["steps"]}
    roles = {role: 0 for role in ("object", "dark", "white")}
    for frame in steps["filters", "calibrate"]["frames"]:
        roles[frame["role"]] += 1
        for name, sha in frame["files"].items():
            assert sha == hash_file(world.folder / name)
    assert roles == {"object": 4, "dark": 4, "white": 4}
    assert {stage for camera, stage in steps if camera == "scan"} == {
        "calibrate",
        "register",
        "resample",
    }
    files = {n for f in steps["scan", "calibrate"]["frames"] for n in f["files"]}
    assert {"scan/panel_2.hdr", "scan/panel_2.raw", "scan/white_1.raw"} <= files


def test_the_chart_is_kept_and_measured(world):
    record = json.loads((world.database / "charts/macbeth/macbeth_filters.json").read_text())
    assert len(record["patches"]) == 24
    camera = json.loads((world.database / "cameras/filters/camera.json").read_text())
    assert camera["measured"][""][""]["sensor"]["gain"] == pytest.approx(0.2, rel=0.1)
