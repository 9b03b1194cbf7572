"""Dark, white and object of different sizes: told, whatever the camera."""

import numpy as np
import pytest
import tifffile

from levkas.building import build, summarise
from levkas.database.spectral_tiff import read_tiff_pages

TEXT = """[campaign]
reference = "c"
[cameras.c]
kind = "KIND"
files = "FILES"
bits = 12
MORE
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.9 }
objects = ["panel"]
"""
KINDS = {
    "mosaic": ("{target}.tif", 'pattern = "RGGB"'),
    "bands": ("{target}_{wavelength}nm.tif", "wavelengths = [500, 600]"),
    "cube": ("{target}.tif", ""),
    "mirror": ("{target}.tif", 'scan = "mirror"'),
}
SIZE = (64, 64)


def built(folder, kind, sizes=None, more=None):
    """Build a campaign of one camera; `sizes` are those of targets of another size."""
    rng, (files, keys) = np.random.default_rng(1), KINDS[kind]
    for target, level in (("dark", 100), ("white", 3000), ("panel", 1500)):
        size = (sizes or {}).get(target, SIZE)
        for wavelength in (500, 600):
            name = files.format(target=target, wavelength=wavelength)
            deep = (2, *size) if kind in ("cube", "mirror") else size
            codes = rng.normal(level, 10, deep).astype(np.uint16)
            tifffile.imwrite(folder / name, codes, photometric="minisblack", metadata=None)
    text = TEXT.replace("KIND", "cube" if kind == "mirror" else kind).replace("FILES", files)
    (folder / "campaign.toml").write_text(
        text.replace("MORE", more or keys) + "[database]\nnative = true\n"
    )
    return summarise(build(folder, output=folder / "database"))


@pytest.mark.parametrize("odd", ["dark", "white"])
@pytest.mark.parametrize(
    ("kind", "size"),
    [*((kind, (64, 60)) for kind in KINDS), ("mosaic", (1, 64)), ("bands", (1, 64)), ("mirror", (1, 64))],
)  # fmt: skip
def test_templates_of_another_size_than_the_object_are_refused_by_name(tmp_path, kind, size, odd):
    report = built(tmp_path, kind, {odd: size})
    problem = report.problems[0]
    assert not report.ok and problem.code == "E_SIZE"
    assert problem.message == f"{odd} and object differ in size"
    assert odd in problem.file and str(min(size)) in problem.found and "64" in problem.expected


def test_the_one_white_of_another_size_is_named_among_those_of_all_bands(tmp_path):
    built(tmp_path, "bands")
    tifffile.imwrite(tmp_path / "white_600nm.tif", np.full((60, 64), 3000, np.uint16))
    (problem,) = summarise(build(tmp_path, output=tmp_path / "database")).problems
    assert problem.file == str(tmp_path / "white_600nm.tif")
    assert (problem.found, problem.expected) == ("64 x 60", "64 x 64")


def test_a_frame_smaller_than_its_pattern_is_refused(tmp_path):
    small = dict.fromkeys(("dark", "white", "panel"), (2, 64))
    report = built(tmp_path, "mosaic", small, 'pattern = [["A", "B"], ["C", "D"], ["E", "F"]]')
    problem = report.problems[0]
    assert (problem.code, problem.found, problem.expected) == ("E_SIZE", "64 x 2", "at least 2 x 3")


def test_a_push_broom_camera_whose_templates_are_one_line_has_no_sigma(tmp_path):
    report = built(tmp_path, "cube", {"dark": (1, 64), "white": (1, 64)})
    assert report.ok, report.text
    found = tmp_path / "database/objects/panel/native"
    assert read_tiff_pages(found / "panel_c.tif").mean() == pytest.approx(0.9 * 14 / 29, rel=0.01)
    assert not (found / "panel_c.sigma.tif").exists()


@pytest.mark.parametrize("odd", [500, 600, 700])
@pytest.mark.parametrize("targets", [("dark", "white", "panel"), ("panel",)], ids="".join)
def test_a_band_of_another_size_than_the_others_is_refused_by_its_file(tmp_path, odd, targets):
    rng = np.random.default_rng(1)
    for target, level in (("dark", 100), ("white", 3000), ("panel", 1500)):
        for wavelength in (500, 600, 700):
            size = (64, 65) if wavelength == odd and target in targets else SIZE
            codes = rng.normal(level, 10, size).astype(np.uint16)
            tifffile.imwrite(tmp_path / f"{target}_{wavelength}nm.tif", codes)
    files, _ = KINDS["bands"]
    text = TEXT.replace("KIND", "bands").replace("FILES", files).replace("MORE", "")
    (tmp_path / "campaign.toml").write_text(text)
    report = summarise(build(tmp_path))
    (problem,) = report.problems
    assert problem.code == "E_SIZE" and problem.file == str(tmp_path / f"panel_{odd}nm.tif")
    assert (problem.found, problem.expected) == ("65 x 64", "64 x 64")
