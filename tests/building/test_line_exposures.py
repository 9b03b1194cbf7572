"""Line scans whose dark, white and object were exposed for different times."""

import numpy as np
import pytest

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.problems import Refused
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

GAIN, READ, BLACK, CURRENT = 0.5, 2.0, 100.0, 4000.0
LIGHT = 150_000.0  # counts a second of the white
BANDS = np.arange(6)
KEYS = """
[campaign]
reference = "scan"
[cameras.scan]
kind = "cube"
files = "{files}"
bits = 12
scan = "{scan}"
{more}
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""
WAYS = ["push-broom", "mirror"]
ONE = np.ones(len(BANDS))


def scene(lines=40, samples=50):
    return np.random.default_rng(3).uniform(0.1, 0.9, (lines, samples, len(BANDS)))


def write(path, light, times, *, said="", black=BLACK, rng=None):
    """Write a scan of a scene, exposed for `times`, s, a band each; `said` of it in its header."""
    rng = rng or np.random.default_rng(sum(path.name.encode()))
    counts = (LIGHT * light + CURRENT) * times
    codes = GAIN * rng.poisson(counts / GAIN) + black
    codes = np.rint(codes + rng.normal(0, READ, codes.shape)).clip(0, 4095).astype(np.uint16)
    path.with_suffix(".raw").write_bytes(codes.transpose(0, 2, 1).tobytes())
    lines, samples, bands = codes.shape
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"data type = 12\nbyte order = 0\nheader offset = 0\n{said}\n"
        f"wavelength = {{{', '.join(str(500 + 40 * b) for b in BANDS)}}}\n"
    )


def make(folder, times, *, scan="push-broom", said="tint = {ms}", files="{target}.hdr", more=""):
    """Write a campaign; `times`, s, by target, or a list of them of several darks or whites."""
    panel = scene()
    folder.mkdir()
    for target, light in (("dark", 0 * panel), ("white", 1 + 0 * panel), ("panel", panel)):
        for number, time in enumerate(np.atleast_1d(np.asarray(times[target], object))):
            every = np.broadcast_to(np.asarray(time, float), ONE.shape)
            ms = f"{1e3 * time:g}" if np.ndim(time) == 0 else None
            text = said.get(target, "") if isinstance(said, dict) else said
            text = text.format(
                ms=ms, list=", ".join(f"{1e3 * t:g}" for t in every), us=1e6 * every[0]
            )
            name = files.replace("{target}", target).replace("{exposure}", str(ms))
            write(folder / name.replace("*", str(number)), light, every, said=text)
    (folder / "campaign.toml").write_text(KEYS.format(scan=scan, files=files, more=more))
    return folder


def developed(folder):
    """Return values, sigma and warnings of the scan."""
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused, refused
    shelf = TemplateCache(folder / "kept")
    native = develop(capture, campaign, shelf)
    (cube,) = native.cubes.values()
    return cube.values, cube.sigma, native.warnings


def recovered(folder):
    values, sigma, warnings = developed(folder)
    miss = (values - scene()) / sigma
    assert (values / scene()).mean((0, 1)) == pytest.approx(ONE, abs=0.006)
    assert 0.93 < miss.std() < 1.07
    return warnings


@pytest.mark.parametrize("scan", WAYS)
def test_twice_the_time_and_the_same_counts_are_half_the_reflectance(tmp_path, scan):
    folder = tmp_path / "c"
    folder.mkdir()
    for name, light, time, ms in (
        ("dark", 0, 0.01, 10),
        ("white", 1, 0.01, 10),
        ("panel", 1, 0.01, 20),
    ):
        write(folder / name, light + 0 * scene(), time * ONE, said=f"tint = {ms}", black=BLACK - 40)
    more = "black = 60"
    keys = KEYS.format(scan=scan, files="{target}.hdr", more=more).replace('dark = "dark"\n', "")
    (folder / "campaign.toml").write_text(keys)
    values, _, warnings = developed(folder)
    # The dark current of 10 ms, 40 counts of 1540, is not known here.
    assert values.mean() == pytest.approx(0.5, abs=1e-3)
    assert any("the linearity is unknown" in w for w in warnings)


@pytest.mark.parametrize("scan", WAYS)
@pytest.mark.parametrize(
    "darks", [[0.01, 0.02], [0.005, 0.02], 0.02], ids=["own", "line", "scaled"]
)
def test_each_frame_has_its_own_dark(tmp_path, scan, darks):
    times = {"dark": darks, "white": 0.01, "panel": 0.02}
    files = "{target}_*.hdr" if isinstance(darks, list) else "{target}.hdr"
    warnings = recovered(make(tmp_path / "c", times, scan=scan, files=files, more="black = 100"))
    assert any("scaled" in w for w in warnings) == (darks == 0.02)
    assert any("on the line" in w for w in warnings) == (darks == [0.005, 0.02])


@pytest.mark.parametrize("scan", WAYS)
def test_exposures_may_be_listed_band_by_band(tmp_path, scan):
    white, panel = 0.01 * ONE, np.linspace(0.005, 0.02, len(BANDS))
    times = {"dark": [white, panel], "white": [white], "panel": [panel]}
    keys = {"scan": scan, "files": "{target}_*.hdr", "said": "integration times (ms) = {{{list}}}"}
    recovered(make(tmp_path / "c", times, **keys))


@pytest.mark.parametrize("scan", WAYS)
def test_names_and_a_manifest_say_exposures_of_scans_too(tmp_path, scan):
    times = {"dark": [0.01, 0.02], "white": 0.01, "panel": 0.02}
    recovered(make(tmp_path / "c", times, scan=scan, said="", files="{target}_{exposure}ms.hdr"))
    folder = make(
        tmp_path / "d", {"dark": 0.01, "white": 0.01, "panel": 0.01}, said="tint = 40", scan=scan,
        more='manifest = "times.csv"',
    )  # fmt: skip
    rows = ["file,exposure_s", *(f"{name}.hdr,0.01" for name in ("dark", "white", "panel"))]
    (folder / "times.csv").write_text("\n".join(rows))
    recovered(folder)


@pytest.mark.parametrize("scan", WAYS)
def test_of_several_whites_the_longest_that_is_not_saturated_counts(tmp_path, scan):
    times = {"dark": [0.01, 0.02, 0.04], "white": [0.01, 0.02, 0.04], "panel": 0.02}
    recovered(make(tmp_path / "c", times, scan=scan, files="{target}_*.hdr"))


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ({"panel": "tint = {ms}", "dark": "tint = {ms}"}, "white.hdr"),
        (
            {"panel": "exposure = {ms}", "white": "exposure = {ms}", "dark": "exposure = {ms}"},
            "unit",
        ),
        ({"panel": "tint = 10", "white": "exposure time = 20 ms", "dark": ""}, "dark.hdr"),
    ],
    ids=["only some say it", "no unit", "not of the dark"],
)
def test_exposures_that_are_not_known_of_every_frame_are_refused(tmp_path, said, found):
    folder = make(tmp_path / "c", {"dark": 0.01, "white": 0.01, "panel": 0.02}, said=said)
    with pytest.raises(Refused) as refused:
        developed(folder)
    (problem,) = refused.value.problems
    assert problem.code == "E_EXPOSURES" and found in str(problem) and "manifest" in problem.fix


def test_an_exposure_without_a_unit_does_no_harm_where_all_have_the_same(tmp_path):
    times = {"dark": 0.01, "white": 0.01, "panel": 0.01}
    recovered(make(tmp_path / "c", times, said="integration time = {us}"))


@pytest.mark.parametrize("scan", WAYS)
def test_a_dark_of_another_time_is_refused_where_the_black_level_is_unknown(tmp_path, scan):
    times = {"dark": 0.01, "white": 0.01, "panel": 0.02}
    with pytest.raises(Refused) as refused:
        developed(make(tmp_path / "c", times, scan=scan))
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_EXPOSURES", "black")
    values, _, _ = developed(make(tmp_path / "d", times, scan=scan, more=f"black = {BLACK:g}"))
    assert values.mean() == pytest.approx(scene().mean(), rel=0.005)
