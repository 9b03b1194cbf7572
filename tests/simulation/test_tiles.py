"""Campaigns whose cameras capture in tiles."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.campaign.discovery.tiles import read_positions
from levkas.simulation.campaigns import simulate_campaign
from levkas.simulation.presets import PRESETS, SimulationRefused, choose_cameras, choose_tiles
from levkas.simulation.truth import SimulatedTruth

TINY = replace(
    PRESETS["small"], scale=0.1, fineness=1.0, supersampling=2, wobble=(1.5, 20.0), stage_deg=0.0
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles") / "campaign"
    tiles = ["d80=2x3", "lctf-vis=1x2", "v10=1x2"]
    list(simulate_campaign(folder, seed=11, preset=TINY, cameras=["d80", "v10"], tiles=tiles))
    return folder


def test_neighbours_see_the_same_points_where_the_stage_put_them(folder):
    truth = SimulatedTruth.load(folder / "truth")
    places = np.load(folder / "truth/icon1_panel_mm.npy")
    stage = read_positions(folder / "d80_stage.csv")
    seen = {t: np.load(folder / f"truth/icon1_d80#{t}_px.npy")[2] for t in stage}
    left, right = (
        seen[t] for t in ("r1c1", "r1c2")
    )  # all of the second one is on the board across
    both = np.isfinite(left + right).all(1)
    width = truth.cameras["d80#r1c1"].width
    assert both.sum() / np.isfinite(right).all(1).sum() == pytest.approx(0.25, abs=0.05)
    apart = np.median(left[both, 0] - right[both, 0])
    assert apart == pytest.approx(0.75 * width, abs=4)
    assert np.std(left[both, 0] - right[both, 0]) < 1.5
    back = truth.to_panel(left[both], "d80#r1c1", "G")
    np.testing.assert_allclose(back, places[both], atol=1e-3)
    together = np.isfinite(np.stack([*seen.values()])).all(2).any(0)
    assert together.mean() > 0.99


def test_what_are_no_tiles_is_refused():
    models = choose_cameras(TINY, ["d80", "v10"])
    for tiles, overlap in (("3 by 4", 0.2), ("v11=2x2", 0.2), ("d80=2x2", 0.9)):
        with pytest.raises(SimulationRefused):
            choose_tiles(models, tiles, overlap)
