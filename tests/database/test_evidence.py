"""The evidence of a registration as pages show it: predicted error, likeness, pairs by hand."""

import numpy as np
import pytest

from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.pixel_frames import predict_error
from levkas.database.registrations import read_registration, shares_light
from levkas.geometry.transforms import Affine

NODES = {"x": [0.0, 99.0], "y": [0.0, 99.0]}


def write_record(root, **numbers):
    """Write a record of a grid that is moved by (10, 20) px of the reference."""
    band = {
        "transform": Affine.identity().to_dict(),
        "sigma": {**NODES, "sigma_px": [[0.1, 0.2], [0.1, 0.2]]},
    }
    record = {
        "object": "a", "camera": "cam", "reference": {"camera": "cam", "band": "G", "size": [100, 100]},
        "grid": {"size": [60, 40], "transform": Affine(np.array([[1.0, 0, 10], [0, 1, 20]])).to_dict()},
        "verdict": {"decision": "warn", "reasons": [], "numbers": {"sensor": numbers}},
        "bands": {"G": band, "R": {**band, "sigma": {**NODES, "sigma_px": [[0.15, 0.15], [0.15, 0.15]]}}},
    }  # fmt: skip
    path = root / "objects/a/registration/cam.json"
    write_json(path, record)
    return path


def test_the_predicted_error_is_the_worst_bands_and_unknown_where_nothing_confirms_the_map(
    tmp_path,
):
    path = write_record(tmp_path, unsupported=[[10, 20, 5, 4]], off=[[30, 30, 2, 2]])
    error = predict_error(read_registration(path), (60, 40))
    assert error.shape == (40, 60)
    unknown = np.zeros((40, 60), bool)
    unknown[:4, :5] = unknown[10:12, 20:22] = True
    np.testing.assert_array_equal(np.isnan(error), unknown)
    expected = np.maximum(0.15, 0.1 + 0.1 * (np.arange(60) + 10) / 99)
    np.testing.assert_allclose(error[30], expected)


def test_cells_that_are_no_rectangles_are_refused(tmp_path):
    for cells in ([[1, 2, 3]], [["x", 0, 1, 1]], [5], "no"):
        with pytest.raises(Refused):
            read_registration(write_record(tmp_path, off=cells))


def test_likeness_is_defined_between_pictures_in_the_same_light_alone():
    nan = float("nan")
    xray = {"errors": {"sensors": {"": {"alike": False}}}}
    colour = {"errors": {"sensors": {"": {"alike": True}}}}
    assert not shares_light(xray, [nan]) and shares_light(colour, [nan] * 3)
    assert (
        shares_light(xray, [850.0]) and shares_light({}, [nan] * 3) and not shares_light({}, [nan])
    )
