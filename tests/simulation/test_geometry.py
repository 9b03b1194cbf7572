"""The exact maps: inverse after forward, the ledge that hides, the record that is read back."""

import numpy as np
import pytest

from levkas.simulation.optics import ChromaticOptics, Viewpoint, base_to_panel, panel_to_base, turn
from levkas.simulation.painting import Panel
from levkas.simulation.truth import BandGeometry, CameraGeometry, SimulatedTruth

BENT = Panel(radius_mm=2500.0, depth_mm=4.0, bevel_mm=4.0, twist_mm=1.0)
DISTANCE = 1850.0


def view(*, motion=None, tilt=(0.8, -1.1, 0.6), scale=1.0):
    rotation = turn(*tilt)
    return Viewpoint(
        round(1392 * scale),
        round(1040 * scale),
        tuple(rotation.ravel()),
        (3.0, -2.0, DISTANCE),
        2.7 * scale * DISTANCE,
        (690.0 * scale, 515.0 * scale),
        696.0 * scale,
        (-0.012, 0.002),
        (3e-4, -2e-4),
        motion,
        1 / (2.7 * scale),
        (0.2, 140.0, 0.3),
    )


def board_points(n=400, share=0.98):
    rng = np.random.default_rng(1)
    return rng.uniform(-0.5, 0.5, (n, 2)) * (BENT.width_mm * share, BENT.height_mm * share)


def truth(panel=BENT, tilt=(0.8, -1.1, 0.6)):
    colour = ChromaticOptics((1e-3, 5e-4), (0.2,), (-0.1,), (0.3,))
    bands = (BandGeometry("550 nm", 550.0), BandGeometry("900 nm", 900.0))
    turned = np.array([[1.0, -0.002, 3.0], [0.002, 1.0, -5.0]])
    chips = (BandGeometry("G", 540.0, "a"), BandGeometry("IR", 820.0, "b"))
    cameras = {
        "main": CameraGeometry(1392, 1040, bands),
        "scan": CameraGeometry(1392, 1040, bands, colour),
        "split": CameraGeometry(1392, 1040, chips, colour, {"a": np.eye(2, 3), "b": turned}),
    }
    views = {
        "main": view(tilt=tilt),
        "scan": view(motion=(0.01, 1.0, 0.0)),
        "split": view(tilt=(-1.0, 0.5, -0.4)),
    }
    return SimulatedTruth(("main", "550 nm"), {"icon1": panel}, cameras, {"icon1": views})


@pytest.mark.parametrize("motion", [None, (0.01, 1.0, 0.0)], ids=["frame", "scanner"])
def test_a_pixel_sees_the_point_that_is_projected_into_it(motion):
    points = board_points()
    v = view(motion=motion)
    np.testing.assert_allclose(
        base_to_panel(panel_to_base(points, v, BENT), v, BENT), points, atol=1e-7
    )


@pytest.mark.parametrize(
    ("camera", "band"), [("main", "550 nm"), ("scan", "900 nm"), ("scan", None), ("split", "IR")]
)
def test_the_map_and_its_inverse_meet_to_a_millionth_of_a_pixel(camera, band):
    t = truth()
    points = t.grid(count=300)
    there = t.map(points, camera, band)
    good = np.isfinite(there).all(1)
    assert good.mean() > 0.95
    np.testing.assert_allclose(t.inverse(there[good], camera, band), points[good], atol=1e-6)


def test_what_a_steep_ledge_hides_is_nan_and_the_rest_is_not():
    steep = Panel(depth_mm=6.0, bevel_mm=0.2)
    t = truth(steep, tilt=(0.0, -13.0, 0.0))
    s = 0.5 * steep.width_mm - steep.border_mm
    # Just inside both ledges, left and right: only one of them stands in the camera's way.
    at_foot = np.array([[-s + 0.25, 0.0], [s - 0.25, 0.0], [0.0, 0.0]])
    valid = np.isfinite(t.from_panel(at_foot, "main")).all(1)
    assert valid.tolist() in ([True, False, True], [False, True, True])


def test_written_truth_is_read_back_exactly(tmp_path):
    t = truth()
    t.save(tmp_path)
    again = SimulatedTruth.load(tmp_path)
    points = np.load(tmp_path / "icon1_ref_px.npy")
    rows = np.load(tmp_path / "icon1_scan_px.npy")
    assert 2500 < len(points) < 3500
    assert rows.shape == (3, len(points), 2)
    np.testing.assert_array_equal(again.map(points, "scan"), rows[0])
    np.testing.assert_array_equal(again.map(points, "scan", "900 nm"), rows[2])
