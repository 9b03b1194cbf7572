"""Campaigns of every kind of camera, quickly built."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import toy


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> toy.Toys:
    """Put stages that write a line of text in the place of a build's."""
    return toy.install(monkeypatch)


@pytest.fixture(scope="session")
def make_every_kind() -> Callable[..., Path]:
    """Return the function that writes a campaign of every kind of camera."""
    return runpy.run_path(str(Path(__file__).with_name("every_kind.py")))["make"]
