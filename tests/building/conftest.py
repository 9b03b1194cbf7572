"""Campaigns of every kind of camera, quickly built."""

import runpy
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def make_every_kind() -> Callable[..., Path]:
    """Return the function that writes a campaign of every kind of camera."""
    return runpy.run_path(str(Path(__file__).with_name("every_kind.py")))["make"]


@pytest.fixture(scope="session")
def small_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a campaign of a line scan that is not to be changed; builds go elsewhere."""
    from levkas.simulation import simulate_campaign

    folder = tmp_path_factory.mktemp("scan") / "campaign"
    for _ in simulate_campaign(folder, preset="small", scale=0.2, cameras=["v10"]):
        pass
    return folder
