"""Tag 65000 of a broad-band camera holds the centroids of its sensitivities, in every file of a layer."""

import numpy as np
import pytest

import levkas
from levkas.building import build, status, summarise
from levkas.database.spectral_tiff import read_stiff
from levkas.database.tiff_pages import open_pages

CENTRES = {"R": 610.0, "G": 540.0, "B": 460.0}


def write_table(path, centres):
    """Triangles, 40 nm to either side: their centroids are their peaks."""
    rows = [
        ",".join([str(w), *(str(max(0.0, 1 - abs(w - c) / 40)) for c in centres.values())])
        for w in range(400, 701, 5)
    ]
    path.write_text("\n".join([",".join(["wavelength", *centres]), *rows]) + "\n")


def tags(folder):
    """Tag 65000 of every TIFF of the photograph, native and on the grid, with flags and sigma."""
    files = sorted(folder.rglob("one_photo*.tif"))
    assert len(files) >= 4
    return {tuple(next(t for t in open_pages(f).tags(65000) if t)) for f in files}


@pytest.fixture
def campaign(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    text = (folder / "campaign.toml").read_text()
    text = text.replace("[cameras.photo]\n", '[cameras.photo]\nsensitivity = "photo.csv"\n')
    (folder / "campaign.toml").write_text(text + "[database]\nnative = true\n")
    write_table(folder / "photo.csv", CENTRES)
    return folder


@pytest.mark.slow
def test_a_build_writes_centroids_of_broad_channels_and_knows_what_they_rest_on(campaign):
    report = summarise(list(build(campaign)))
    assert report.ok, report.problems
    database = campaign / "database"
    (reported,) = tags(database)
    np.testing.assert_allclose(reported, list(CENTRES.values()), atol=1e-3)
    layer = database / "objects/one/one_photo.tif"
    # As the format has it, `read_stiff` gives the bands by rising wavelength: blue first.
    assert read_stiff(layer)[1].tolist() == sorted(reported)
    # A broad channel has no centre: whoever opens the layer is told so.
    opened = levkas.open(database)["one"]["photo"]
    assert opened["band"].values.tolist() == list(CENTRES)
    assert np.isnan(opened["wavelength"].values).all()

    moved = {label: centre + 15 for label, centre in CENTRES.items()}
    write_table(campaign / "photo.csv", moved)
    stale = [step for step in status(campaign).stages if step.state == "stale"]
    assert any("photo.csv" in step.why for step in stale)
    assert summarise(list(build(campaign))).ok
    (reported,) = tags(database)
    np.testing.assert_allclose(reported, list(moved.values()), atol=1e-3)
