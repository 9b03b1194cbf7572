"""Captures that do not fit in memory: refused by name, and the other cameras go on."""

import pytest

from levkas.building import build
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.simulation import simulate_campaign
from levkas.stages import native_cubes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fitting") / "campaign"
    for _ in simulate_campaign(
        folder, preset="small", scale=0.1, cameras=["lctf-vis", "v10", "d80"]
    ):
        pass
    return folder


def built(folder, output):
    return {(s.key.layer, s.key.stage): s for s in build(folder, output=output) if s.key.object}


def test_what_does_not_fit_is_refused_before_it_is_read(simulated, tmp_path, monkeypatch):
    campaign = load_campaign(simulated)
    captures = {c.camera: c for c in find_captures(campaign)[0]}
    values = {
        n: native_cubes.count_values(c, campaign.cameras[n].kind) for n, c in captures.items()
    }
    header = captures["v10"].sensors[0].object[0].path.with_suffix(".hdr")
    sides = {
        key.strip(): int(number)
        for key, _, number in (line.partition("=") for line in header.read_text().splitlines())
        if key.strip() in ("samples", "lines", "bands")
    }
    assert values["v10"] == sides["samples"] * sides["lines"] * sides["bands"]
    needed = native_cubes.CUBE_BYTES * values["v10"]
    free = iter([1e12, needed - 1.0, needed + 0.0] + 9 * [1e12])  # the reference comes first
    monkeypatch.setattr(native_cubes, "memory_bound", lambda: next(free))
    ended = built(simulated, tmp_path / "database")
    (problem,) = ended["v10", "calibrate"].problems
    assert problem.code == "E_MEMORY" and problem.file and "GB" in problem.expected
    assert ended["d80", "calibrate"].state == "done"
    again = built(simulated, tmp_path / "database")  # where there is room now
    assert again["v10", "calibrate"].state == "done"
