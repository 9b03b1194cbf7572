"""Native pixels are in the database where the campaign asks for them; all else is the same without."""

import json

import numpy as np
import pytest

from levkas.building import build, status, summarise
from levkas.core.digests import hash_tree
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.quality.evaluation.native_layers import ComparisonRefused, native_files
from levkas.workbench.library import Library

KEY = "[database]\nnative = true\n"
LISTING = ("manifest-sha256.txt", "objects/one/provenance.json")


def states(report):
    return {f"{s.key.layer} {s.key.stage}": s.state for s in report.stages if s.key.camera}


def without_native(tree):
    return {n: h for n, h in tree.items() if "/native/" not in n and not n.endswith(LISTING)}


def built(folder):
    report = summarise(build(folder))
    assert report.ok, report.text
    return report, hash_tree(folder / "database")


@pytest.fixture(scope="module")
def plate(make_plates, tmp_path_factory):
    """A campaign built without the key, with it, and without it again: what was done, and all hashes."""
    folder = make_plates(tmp_path_factory.mktemp("plate") / "campaign", ("one",))
    keys = (folder / "campaign.toml").read_text()
    first = built(folder)
    (folder / "campaign.toml").write_text(keys + KEY)
    due = status(folder)
    second = built(folder)
    native = folder / "database/objects/one/native/one_photo.tif"
    pixels = read_tiff_pages(native)
    (folder / "campaign.toml").write_text(keys)
    third = built(folder)
    return folder, (first, second, third), due, pixels


@pytest.mark.slow
def test_the_key_adds_the_folder_and_changes_nothing_else(plate):
    _, ((_, plain), (_, native), (_, again)), _, _ = plate
    assert not any("/native/" in name for name in plain)
    assert sum("/native/" in name for name in native) >= 4
    assert without_native(native) == without_native(plain)
    assert again == plain


def test_the_key_makes_the_calibration_stale_and_no_other_stage_of_a_capture(plate):
    _, (_, second, third), due, _ = plate
    for report in (due, second[0], third[0]):
        done = {k for k, state in states(report).items() if state in ("stale", "done")}
        stages = {k.split()[-1] for k in done}
        assert {"photo calibrate", "infrared calibrate"} <= done, done
        assert stages <= {"calibrate", "camera"}, done


def test_the_workbench_shows_the_pixels_that_the_database_does_not_hold(plate):
    folder, _, _, pixels = plate
    library = Library(folder)
    view = next(v for v in library.views.values() if v.capture.camera == "photo")
    band = view.labels[0]
    shown = library.picture(view.capture, band).pixels
    values = np.asarray(pixels)[..., 0].astype(float)
    low, high = np.percentile(values, (0.5, 99.5))
    expected = 255 * np.sqrt(np.clip((values - low) / (high - low), 0, 1))
    assert shown.shape == values.shape
    assert np.abs(shown - expected).mean() < 6  # limits are those of some rows
    (kept,) = (folder / "database.kept/one/photo").glob("native-*")
    written = kept / "one_photo.tif"
    before = written.stat().st_mtime_ns
    library.picture(view.capture, view.labels[-1])
    Library(folder).picture(view.capture, band)
    assert written.stat().st_mtime_ns == before


def test_what_reads_native_pixels_alone_names_the_key(plate):
    with pytest.raises(ComparisonRefused) as refused:
        native_files(plate[0] / "database", "one", "photo", "")
    (problem,) = refused.value.problems
    assert (problem.field, problem.expected) == ("database.native", "true")
    assert "native = true" in problem.fix and "campaign.toml" in problem.fix


@pytest.mark.slow
def test_a_refused_capture_is_shown_on_the_page_as_it_was_recorded(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ("one",))
    (path,) = folder.glob("infrared/one.*")
    import cv2

    noise = np.random.default_rng(1).integers(0, 255, cv2.imread(str(path), 0).shape, np.uint8)
    cv2.imwrite(str(path), noise)
    report = summarise(build(folder))
    assert states(report)["infrared register"] == "refused"
    page = (folder / "database/objects/one/report.html").read_text()
    assert 'alt="infrared as it was recorded"' in page
    record = json.loads((folder / "database/objects/one/registration/infrared.json").read_text())
    assert record["verdict"]["decision"] == "refuse"
