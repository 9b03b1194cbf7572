"""Dark, white and object of different sizes: told, whatever the camera."""

import numpy as np
import pytest
import tifffile

from levkas.building import build, summarise

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


@pytest.mark.parametrize("odd", ["dark", "white"])
@pytest.mark.parametrize("kind", KINDS)
def test_templates_of_another_size_than_the_object_are_refused_by_name(tmp_path, kind, odd):
    rng, (files, more) = np.random.default_rng(1), KINDS[kind]
    for target, level in (("dark", 100), ("white", 3000), ("panel", 1500)):
        size = (64, 60) if target == odd else (64, 64)
        for wavelength in (500, 600):
            name = files.format(target=target, wavelength=wavelength)
            deep = (2, *size) if kind in ("cube", "mirror") else size
            codes = rng.normal(level, 10, deep).astype(np.uint16)
            tifffile.imwrite(tmp_path / name, codes, photometric="minisblack", metadata=None)
    kind = "cube" if kind == "mirror" else kind
    text = TEXT.replace("KIND", kind).replace("FILES", files).replace("MORE", more)
    (tmp_path / "campaign.toml").write_text(text)
    report = summarise(build(tmp_path, output=tmp_path / "database"))
    assert not report.ok
    problem = report.problems[0]
    assert (
        problem.code == "E_SIZE" and problem.message == f"{odd} and object are of different sizes"
    )
    assert f"{odd}" in problem.file and "60" in problem.found and "64" in problem.expected
