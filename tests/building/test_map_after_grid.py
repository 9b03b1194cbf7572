"""Points mapped after `[grid]` changed: by the database as it is, and by the new grid once it is built."""

import numpy as np
import pytest

from levkas.building import build, status, summarise
from levkas.database.pixel_frames import map_points


@pytest.mark.slow
def test_points_are_mapped_by_the_grid_that_was_built(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    assert summarise(build(folder)).ok
    points = np.array([[20.0, 30.0], [100.0, 100.0]])

    def mapped():
        return map_points(folder / "database", "one", points, source="grid", target="photo")

    before = mapped()
    with (folder / "campaign.toml").open("a") as file:
        file.write("[grid]\nregion = [10, 12, 200, 150]\n")
    assert np.array_equal(mapped(), before)  # nothing was built yet
    stale = {s.key.stage for s in status(folder).stages if s.state == "stale"}
    assert "resample" in stale
    assert summarise(build(folder)).ok
    assert np.allclose(mapped(), points + np.array([10, 12]), atol=1e-6)
    assert np.allclose(before, points, atol=1e-6)
