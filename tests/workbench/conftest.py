"""A campaign with one planted wrong pair, opened as the workbench does."""

import pytest

from levkas.campaign.edits import FrameEdits, read_edits
from levkas.workbench.library import Library, id_of


@pytest.fixture
def folder(correctable, tmp_path):
    return correctable.make(tmp_path / "campaign")


@pytest.fixture
def library(folder):
    return Library(folder)


@pytest.fixture
def frame(library):
    return library.open(id_of("icon", "xray"))


@pytest.fixture
def corrected(folder):
    """Return a function that reads the corrections of the radiograph in edits.toml."""
    return lambda: read_edits(folder / "edits.toml").frames.get(("icon", "xray"), FrameEdits())
