"""Campaigns of every kind of camera, quickly built."""

import runpy
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def make_every_kind() -> Callable[..., Path]:
    """Return the function that writes a campaign of every kind of camera."""
    return runpy.run_path(str(Path(__file__).with_name("every_kind.py")))["make"]
