"""Exposures advised from frames of a white: a simulated one through known exposures."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app
from levkas.planning.exposure_advice import NoAdvice, advise_frames
from levkas.planning.exposure_levels import limiting, read_channel, safe_mean

GAIN, PRNU = 0.1, 0.01
"""DN/e⁻, share."""
TILT = np.linspace(0.95, 1.05, 256) * np.ones((192, 1))


def white(rate, time, rng, *, colours=(1.0, 1.0, 1.0, 1.0)):
    """A white of `rate` counts a second through a 2x2 mosaic, 10 % uneven."""
    counts = rate * time * TILT
    counts *= np.tile(np.reshape(colours, (2, 2)), (96, 128))
    response = 1 + PRNU * np.random.default_rng(9).standard_normal(counts.shape)
    lit = rng.poisson(counts / GAIN * response) * GAIN
    return np.clip(np.rint(lit + rng.normal(64, 1, counts.shape)), 0, 4095).astype(np.uint16)


def write(folder, name, frame, **tags):
    folder.mkdir(exist_ok=True, parents=True)
    tifffile.imwrite(folder / name, frame, photometric="minisblack", **tags)
    return folder


@pytest.fixture
def rng():
    return np.random.default_rng(2)


def test_the_papers_85_percent():
    # PRNU 1.9 %, 10 % non-uniformity, 1 % drift, one pixel in a million.
    assert 0.854 <= safe_mean(12_000) <= safe_mean(45_000) <= 0.863


@pytest.mark.parametrize("chance", [1e-3, 1e-4])
def test_the_safe_mean_saturates_as_rarely_as_it_says(chance):
    rng, full = np.random.default_rng(1), 30_000
    share = safe_mean(full, prnu=0.019, unevenness=0.1, chance=chance)
    brightest = share * full * 1.05 * 1.01 * (1 + rng.normal(0, 0.019, 2_000_000))
    clipped = np.mean(rng.poisson(brightest) > full)
    # Shot noise is taken at the mean, not at the brightest place: a little more than `chance`.
    assert 0.5 * chance < clipped < 2 * chance


def test_following_the_advice_brings_the_white_there_and_clips_nothing(rng):
    first = read_channel(white(5000, 0.1, rng), black=64.0, saturation=4095.0)
    second = read_channel(white(5000, 0.1 * first.factor, rng), black=64.0, saturation=4095.0)
    assert second.mean / second.room == pytest.approx(first.target, rel=0.01)
    assert second.clipped == 0 and 0 < second.stops_left < 0.2


def test_the_channel_that_saturates_first_and_the_poorest(rng):
    frame = white(20_000, 0.1, rng, colours=(0.5, 1.0, 1.0, 0.25))
    readings = [
        read_channel(frame[y::2, x::2], black=64.0, saturation=4095.0, channel=name)
        for name, y, x in (("R", 0, 0), ("G", 0, 1), ("B", 1, 1))
    ]
    assert [one.channel for one in limiting(readings)] == ["G", "B"]


def test_bands_of_a_tunable_filter_get_a_time_each_by_darks_of_their_size_and_time(tmp_path, rng):
    for band, rate in ((450, 800), (550, 8000), (650, 20_000)):
        for shot in "ab":
            write(tmp_path / "white", f"{band}nm_100ms_{shot}.tif", white(rate, 0.1, rng))
    for shot in "ab":
        write(tmp_path / "dark", f"100ms_{shot}.tif", white(0, 0.1, rng))
        write(tmp_path / "dark", f"2s_{shot}.tif", white(0, 0.1, rng) + 300)
        write(tmp_path / "dark", f"100ms_cropped_{shot}.tif", white(9, 0.1, rng)[2:] + 90)
    found = advise_frames([tmp_path / "white"], [tmp_path / "dark"], saturation=4095)
    assert [(c.shot.wavelength, c.shot.exposure_s) for c in found] == [
        (450, 0.1),
        (550, 0.1),
        (650, 0.1),
    ]
    for c, rate in zip(found, (800, 8000, 20_000), strict=True):
        assert c.first.room == pytest.approx(4095 - 64, abs=1)
        assert c.time_s * rate / c.first.room == pytest.approx(c.first.target, rel=0.01)


def stops_of(found):
    (reading,) = found.readings
    return reading.stops_left


CAMPAIGN = """
[campaign]
reference = {{ camera = "cam" }}
[cameras.cam]
{keys}
bits = 12
black = 64
[targets]
white = {{ names = "white", reflectance = 0.98 }}
"""


def test_the_brightest_pixel_is_never_taken_for_the_full_scale(tmp_path, rng):
    frame = white(10_000, 0.1, rng)
    write(tmp_path / "raw/white", "a.tif", frame)
    with pytest.raises(NoAdvice) as refused:
        advise_frames([tmp_path / "raw/white"], black=64.0)
    assert refused.value.problems[0].code == "E_BITS"
    dng = (50717, "H", 1, 4095, True)  # WhiteLevel of DNG
    write(tmp_path / "dng", "a.tif", frame, extratags=[dng])
    found = [
        *advise_frames([tmp_path / "raw/white"], black=64.0, bits=12),
        *advise_frames([tmp_path / "raw/white"], black=64.0, saturation=4095.0),
        *advise_frames([tmp_path / "dng"], black=64.0),
    ]
    keys = 'kind = "bands"\nfiles = "raw/{target}/{shot}.tif"\nbands = ["a"]'
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.format(keys=keys))
    found += advise_frames([tmp_path / "raw/white"])
    for one in found:
        assert one.full.counts == 4095
        assert stops_of(one) == pytest.approx(np.log2(4031 / 1080), abs=0.05)


@pytest.mark.parametrize("pattern", ['"RGGB"', '[["a", "b"], ["b", "c"]]'])
def test_the_mosaic_comes_from_the_campaign_that_the_frames_belong_to(tmp_path, pattern, rng):
    folder = tmp_path / "raw" / "white"
    for shot in "12":
        frame = white(20_000, 0.1, rng, colours=(0.5, 1.0, 1.0, 0.25))
        write(folder, f"100ms_{shot}.tif", frame)
    keys = f'kind = "mosaic"\npattern = {pattern}\nfiles = "raw/{{target}}/{{exposure}}ms_{{shot}}.tif"'
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.format(keys=keys))
    result = CliRunner().invoke(app, ["plan", "exposure", str(folder), "--json"])
    (found,) = json.loads(result.stdout)["bands"]
    means = {one["channel"]: one["mean"] for one in found["channels"]}
    names = "RGB" if "R" in pattern else "abc"
    assert means == pytest.approx(dict(zip(names, (1000, 2000, 500), strict=True)), rel=0.02)
    assert found["saturates_first"] == names[1] and found["poorest"] == names[2]
    (given,) = advise_frames([folder], pattern="RGGB")
    assert found["recommended_s"] == pytest.approx(given.time_s)
    assert CliRunner().invoke(app, ["plan", "exposure", str(folder)]).exit_code == 0


def test_all_sixteen_bits_and_bytes_are_full_scales_of_their_own(tmp_path, rng):
    frame = white(10_000, 0.1, rng)
    deep, byte = (
        advise_frames([write(tmp_path / name, "a.tif", codes)])[0].full.counts
        for name, codes in (("deep", frame * 32), ("byte", (frame // 16).astype(np.uint8)))
    )
    assert (deep, byte) == (65535, 255)


def half_black(frame):
    frame[:, : frame.shape[1] // 2] = 80
    return frame


@pytest.mark.parametrize(
    ("made", "code"),
    [
        (lambda rng: white(90_000, 0.4, rng), "E_WHITE_SATURATED"),
        # Codes that pile up below the bits are the full scale.
        (
            lambda rng: np.minimum(white(40_000, 0.1, rng) * (1 - 0.25 * (TILT > 1)), 3600).astype(
                np.uint16
            ),
            "E_WHITE_SATURATED",
        ),
        (lambda rng: white(0, 0.4, rng), "E_WHITE_DARK"),
        (lambda rng: half_black(white(20_000, 0.1, rng)), "E_WHITE_UNEVEN"),
        (lambda rng: white(10_000, 0.1, rng) << 4, "E_BITS"),
    ],
)
def test_frames_that_tell_no_time_are_refused(tmp_path, rng, made, code):
    write(tmp_path / "w", "550nm_400ms.tif", made(rng))
    with pytest.raises(NoAdvice) as refused:
        advise_frames([tmp_path / "w"], bits=12, black=64.0)
    assert refused.value.problems[0].code == code
