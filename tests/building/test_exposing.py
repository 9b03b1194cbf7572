"""Exposures in a build: merged with their sigma, and scaled only where they scale."""

import shutil
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Flag
from levkas.core.problems import Refused
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

GAIN, READ, BLACK = 0.25, 2.0, 64.0
KEYS = """
[campaign]
reference = {{ camera = "cam" }}
[cameras.cam]
{kind}
files = "raw/{{target}}_{{wavelength}}nm_{{exposure}}ms_{{shot}}.tif"
bits = 12
exposures = "{how}"
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""
SHAPE = (192, 256)
SCENE = np.kron(np.random.default_rng(5).uniform(0.02, 0.9, (12, 16)), np.ones((16, 16)))


KINDS = {
    "bands": 'kind = "bands"\nwavelengths = [550]',
    "mosaic": 'kind = "mosaic"\npattern = [["A", "B"], ["C", "D"]]',
}


def make(
    folder,
    how,
    *,
    panel,
    white,
    late=1.0,
    moved=False,
    kind="bands",
    black="",
    dim=1.0,
    odd=(),
    darks=(),
    current=0.0,
    curve=lambda counts: counts,
    flicker=0.0,
    warm=0.0,
):
    """Write a campaign; darks of each time, or of `darks`, s, with a current in counts a second; counts through a curve; `late` is what the longest white really took, over what its name says.

    Exposures of the panel in `odd` took a third more than their names say.

    The lamp flickers from exposure to exposure, darks are `warm` counts too high. `dim`: by which the scene is darker. `black`: where its level stands, in the campaign's "file", in the "frames" or nowhere.
    """
    tags = [(50714, "H", 1, int(BLACK), True)] if black == "frames" else []
    rng, fixed = np.random.default_rng(1), np.random.default_rng(2)
    response = 1 + 0.012 * fixed.standard_normal(SHAPE)
    (folder / "raw").mkdir(parents=True)
    times = sorted({*panel, *white})
    for target, taken, scene in (
        ("dark", darks or times, 0 * SCENE), ("white", white, 0 * SCENE + 1), ("panel", panel, dim * SCENE),
    ):  # fmt: skip
        for time in taken:
            lamp = 1 + flicker * rng.standard_normal()
            for shot in range(6 if target != "panel" else 1):
                observed = scene.copy()
                if moved and target == "panel" and time == max(panel):
                    observed[80:96, 96:112] *= 0.3
                real = time * (late if target == "white" and time == max(white) else 1.0)
                real *= 4 / 3 if target == "panel" and time in odd else 1.0
                real *= lamp
                light = GAIN * rng.poisson(
                    14_000 * real * observed * response + current * time / GAIN
                )
                level = BLACK + (warm if target == "dark" else 0.0)
                raw = np.rint(curve(light) + rng.normal(level, READ, SHAPE)).clip(0, 4095)
                name = f"{target}_550nm_{1000 * time:g}ms_{shot}.tif"
                tifffile.imwrite(folder / "raw" / name, raw.astype(np.uint16), extratags=tags)
    text = KINDS[kind] + (f"\nblack = {BLACK:g}" if black == "file" else "")
    keys = KEYS.format(how=how, kind=text)
    if kind == "mosaic":
        keys = keys.replace("{wavelength}nm", "*")
    (folder / "campaign.toml").write_text(keys)
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    captures, refused = find_captures(campaign)
    assert not refused
    shelf = TemplateCache(folder / "kept")
    return develop(captures[0], campaign, shelf)


def test_merged_exposures_have_the_sigma_that_they_have(tmp_path):
    made = developed(make(tmp_path / "c", "merge", panel=(0.25, 1.0, 4.0), white=(1.0,)))
    cube = made.cubes[""]
    values, sigma = cube.values[..., 0], cube.sigma[..., 0]
    sound = (cube.flags[..., 0] & (Flag.SATURATED | Flag.DEFECT)) == 0
    miss = ((values - SCENE) / sigma)[sound]
    assert sound.mean() > 0.95
    assert 0.95 < miss.std() < 1.05
    assert not (cube.flags & Flag.MOVED).any()


@pytest.mark.parametrize(
    ("times", "odd", "said"),
    [
        (
            (0.25, 0.5, 1.0, 2.0),
            (0.5,),
            "exposures of 0.5 s are not proportional to 0.25 s, 1 s, 2 s",
        ),
        ((0.25, 1.0), (0.25,), "only 1 s is used, 0.25 s not"),
    ],
)
def test_exposures_that_do_not_scale_are_left_out_by_name(tmp_path, times, odd, said):
    made = developed(make(tmp_path / "c", "merge", panel=times, white=(1.0,), odd=odd))
    assert any("550 nm: " in w and said in w for w in made.warnings), made.warnings
    cube = made.cubes[""]
    sound = (cube.flags[..., 0] & (Flag.SATURATED | Flag.DEFECT)) == 0
    miss = ((cube.values[..., 0] - SCENE) / cube.sigma[..., 0])[sound]
    assert abs(cube.values[..., 0][sound].mean() / SCENE[sound].mean() - 1) < 0.005
    assert 0.9 < miss.std() < 1.1
    assert not (cube.flags & Flag.MOVED).any()


@pytest.mark.parametrize("black", ["file", ""])
def test_in_the_dark_a_merge_has_the_sigma_that_it_has_and_nothing_is_flagged_as_moved(
    tmp_path, black
):
    # A stack of one white tells the light's noise, and nothing of the noise without light.
    times, keys = (0.25, 1.0, 4.0), {"white": (1.0,), "dim": 0.005, "black": black}
    cube = developed(make(tmp_path / "c", "merge", panel=times, **keys)).cubes[""]
    miss = (cube.values[..., 0] - 0.005 * SCENE) / cube.sigma[..., 0]
    assert 0.95 < miss.std() < 1.05
    assert not (cube.flags & Flag.MOVED).any()


def test_what_moved_between_exposures_is_flagged(tmp_path):
    folder = make(tmp_path / "c", "merge", panel=(0.25, 1.0), white=(1.0,), moved=True)
    flags = developed(folder).cubes[""].flags[..., 0]
    moved = (flags & Flag.MOVED) != 0
    assert moved[82:94, 98:110].all() and moved.sum() < 22 * 22


def test_another_time_of_the_white_is_allowed_where_a_series_shows_that_counts_scale(tmp_path):
    made = developed(make(tmp_path / "c", "best", panel=(0.5,), white=(0.25, 0.5, 1.0)))
    assert not any("linearity is unknown" in w for w in made.warnings)
    assert made.cubes[""].values[..., 0].mean() == pytest.approx(SCENE.mean(), rel=0.005)


def test_it_is_refused_where_the_series_shows_that_they_do_not(tmp_path):
    folder = make(tmp_path / "c", "best", panel=(0.5,), white=(0.25, 0.5, 1.0), late=1.06)
    with pytest.raises(Refused, match="not proportional to the exposure") as refused:
        developed(folder)
    assert refused.value.problems[0].code == "E_EXPOSURES"


def test_it_is_said_where_no_series_can_tell(tmp_path):
    made = developed(make(tmp_path / "c", "best", panel=(0.5,), white=(1.0,)))
    assert any("the linearity is unknown" in w for w in made.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("whites", [(1.0,), (0.25, 1.0)], ids=["one white", "merged whites"])
def test_a_black_level_that_is_known_is_subtracted_once(tmp_path, kind, whites):
    made = {
        black: developed(
            make(
                tmp_path / f"c{black}",
                "merge",
                panel=(0.25, 4.0),
                white=whites,
                kind=kind,
                black=black,
            )
        ).cubes[""]
        for black in ("file", "frames", "")
    }
    inside = np.kron(np.ones((12, 16)), np.pad(np.ones((8, 8)), 4)) > 0  # of patches
    dim, light = inside & (SCENE < 0.1), inside & (SCENE > 0.5)
    for black, cube in made.items():
        values = cube.values[..., 0] if kind == "bands" else cube.values.mean(2)
        for part in (dim, light):  # the noise of these means is below 0.1 %
            assert values[part].mean() == pytest.approx(SCENE[part].mean(), rel=0.005), black
    # No more than by the darks' own noise do they differ.
    assert abs(made["file"].values - made["frames"].values).max() == 0


@pytest.mark.parametrize("how", ["best", "merge"])
@pytest.mark.parametrize("current", [0.0, 60.0])
def test_a_dark_of_another_time_is_refused_where_nothing_tells_its_current(tmp_path, how, current):
    panel = (0.5,) if how == "best" else (0.25, 0.5)
    more = {"panel": panel, "white": (0.25,), "darks": (0.25,), "current": current}
    with pytest.raises(Refused) as refused:
        developed(make(tmp_path / "c", how, **more))
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_EXPOSURES", "black")
    assert "0.25 s" in problem.message and "0.5 s" in problem.fix and "`black`" in problem.fix
    for more_known in ({"black": "file"}, {"black": "frames"}, {"darks": (0.1, 0.25)}):
        folder = tmp_path / next(iter(more_known)) / more_known.get("black", "")
        cube = developed(make(folder / "c", how, **(more | more_known))).cubes[""]
        dim = SCENE < 0.1
        assert cube.values[..., 0][dim].mean() == pytest.approx(SCENE[dim].mean(), rel=0.005)


@pytest.mark.slow
def test_the_black_level_of_an_exposure_series_serves_to_scale_a_dark(tmp_path):
    panel = (0.25, 0.5, 1.0)
    more = {"panel": panel, "white": (1.0,), "darks": (0.25,), "current": 60.0}
    made = developed(make(tmp_path / "c", "merge", **more))
    assert any("the black level is 6" in warning for warning in made.warnings), made.warnings
    assert made.measured[""]["black"]["counts"] == pytest.approx(BLACK, abs=0.5)
    values, dim = made.cubes[""].values[..., 0], SCENE < 0.1
    assert values[dim].mean() == pytest.approx(SCENE[dim].mean(), rel=0.01)


def test_a_dark_of_nearly_the_time_is_used_and_said(tmp_path):
    more = {"panel": (0.25,), "white": (0.25,), "darks": (0.24,)}
    made = developed(make(tmp_path / "c", "one", **more))
    assert any("0.24 s is used for 0.25 s" in warning for warning in made.warnings)


def bent(counts):
    """A sensor that loses 6 % at its end."""
    return counts - 0.06 * counts**2 / 4000


def knee(counts):
    return np.where(counts < 1500, counts, 1500 + (counts - 1500) * 0.8)


def slightly_bent(counts):
    return counts - 0.015 * counts**2 / 4000


@pytest.mark.parametrize("curve", [slightly_bent, bent])
@pytest.mark.parametrize("how", ["merge", "best"])
def test_a_sensor_that_is_slightly_bent_is_named_and_in_the_budget(tmp_path, how, curve):
    panel = (0.25, 0.5, 1.0)
    made = developed(make(tmp_path / "c", how, panel=panel, white=(1.0,), curve=curve))
    off = [made.cubes[""].values[..., 0][part].mean() / SCENE[part].mean() - 1
           for part in ((SCENE > 0.01) & (SCENE < 0.1), SCENE > 0.6)]  # fmt: skip
    assert max(map(abs, off)) < 1.2 * made.measured[""]["straightness"] < 0.08
    assert any("the sensor is not linear" in w for w in made.warnings)


@pytest.mark.parametrize("panel", [(0.25, 0.5, 1.0), (0.25, 1.0)], ids=["three", "two"])
def test_a_lamp_that_flickers_between_exposures_is_no_curve_and_is_in_the_budget(tmp_path, panel):
    folder = make(tmp_path / "c", "merge", panel=panel, white=(0.5, 1.0), flicker=0.01)
    made = developed(folder)
    assert not any("not linear" in warning for warning in made.warnings), made.warnings
    bright = SCENE > 0.5
    off = made.cubes[""].values[..., 0][bright].mean() / SCENE[bright].mean() - 1
    assert abs(off) < 3 * made.measured[""]["lamp"]["550 nm"]["sigma"] < 0.1
    assert any("the lamp is known between white and object" in w for w in made.warnings)


@pytest.mark.parametrize("curve", [lambda counts: counts, slightly_bent], ids=["linear", "bent"])
def test_darks_of_another_temperature_show_in_an_exposure_series(tmp_path, curve):
    more = {"panel": (0.25, 0.5, 1.0), "white": (1.0,), "curve": curve}
    made = developed(make(tmp_path / "warm", "merge", warm=5.0, **more))
    assert made.measured[""]["offset"]["counts"] == pytest.approx(-5.0, abs=0.5)
    assert any("without light its exposure series have -" in w for w in made.warnings)
    assert "offset" not in developed(make(tmp_path / "cold", "merge", **more)).measured[""]


def own_sensels(cube):
    y, x = np.indices(SHAPE)
    return np.take_along_axis(cube, ((y % 2) * 2 + x % 2)[..., None], 2)[..., 0]


@pytest.mark.parametrize("kind", ["bands", "mosaic"])
def test_a_sensor_that_is_not_linear_is_refused(tmp_path, kind):
    more = {"panel": (0.25, 0.5, 1.0), "white": (1.0,), "kind": kind}
    folder = make(tmp_path / "c", "merge", curve=knee, **more)
    with pytest.raises(Refused) as refused:
        developed(folder)
    assert {problem.code for problem in refused.value.problems} == {"E_EXPOSURES"}


def write_png(path, level, seconds):
    """Write an even frame; its eXIf chunk holds ExposureTime, where there is one."""
    codes = np.random.default_rng(len(path.name)).normal(level, 5, (48, 64)).clip(0, 4095)
    data = cv2.imencode(".png", np.rint(codes).astype(np.uint16))[1].tobytes()
    if seconds:
        exif = struct.pack(">2sHIHHHIII", b"MM", 42, 8, 1, 0x8769, 4, 1, 26, 0)
        exif += struct.pack(">HHHIIIII", 1, 0x829A, 5, 1, 44, 0, round(1e6 * seconds), 10**6)
        chunk = b"eXIf" + exif
        framed = struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk))
        data = data[:33] + framed + data[33:]
    path.write_bytes(data)


PNG = """
[campaign]
reference = "cam"
[cameras.cam]
{kind}
bits = 12
black = 100
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""
PNG_KINDS = {
    "bands": 'kind = "bands"\nfiles = "{target}_{wavelength}nm.png"\nwavelengths = [550]',
    "mosaic": 'kind = "mosaic"\nfiles = "{target}_550nm.png"\npattern = [["A", "B"], ["C", "D"]]',
    "sensors": 'kind = "sensors"\n[[cameras.cam.sensors]]\nname = "one"\nfiles = "{target}_550nm.png"\nbands = ["A"]',
}


@pytest.mark.parametrize("kind", PNG_KINDS)
def test_exposures_in_png_are_read_and_must_be_there_in_all_or_none(tmp_path, kind):
    known = "bits = 12\nblack = 100\n"
    text = PNG_KINDS[kind].replace("\n[[", f"\n{known}[[")
    keys = PNG.format(kind=text).replace(f'A"]\n{known}', 'A"]\n')
    (tmp_path / "campaign.toml").write_text(keys)
    for name, level, seconds in (("dark", 100, 0.01), ("white", 2100, 0.01), ("panel", 2100, 0.02)):
        write_png(tmp_path / f"{name}_550nm.png", level, seconds)
    (cube,) = developed(tmp_path).cubes.values()
    assert cube.values.mean() == pytest.approx(0.5, abs=2e-3)
    for silent in ("dark", "white", "panel"):
        folder = tmp_path / silent
        shutil.copytree(tmp_path, folder, ignore=shutil.ignore_patterns("dark", "white", "panel"))
        write_png(folder / f"{silent}_550nm.png", 100 if silent == "dark" else 2100, None)
        with pytest.raises(Refused) as refused:
            developed(folder)
        (problem,) = refused.value.problems
        assert (problem.code, problem.field) == ("E_EXPOSURES", "exposure")
        assert problem.file.endswith(f"{silent}_550nm.png") and "2 of 3 frames" in problem.message
        assert "manifest" in problem.fix
