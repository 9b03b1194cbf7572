"""The coach: a simulated white through known exposures, and what it advises."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.calibration.noise_model import Sensor
from levkas.cli import app
from levkas.planning.exposure_advice import NoAdvice, advice_text, advise_frames
from levkas.planning.exposure_levels import (
    advise,
    judge_iso,
    limiting,
    read_channel,
    safe_mean,
    snr_at,
)

SENSOR = Sensor(dark=0.0, read=10.0, prnu=0.01, dsnu=0.0, gain=0.1, black=64.0)
TILT = np.linspace(0.95, 1.05, 256) * np.ones((192, 1))


def white(rate, time, rng, *, colours=(1.0, 1.0, 1.0, 1.0)):
    """A white of `rate` counts a second through a 2x2 mosaic, 10 % uneven."""
    counts = rate * time * TILT
    counts *= np.tile(np.reshape(colours, (2, 2)), (96, 128))
    response = 1 + SENSOR.prnu * np.random.default_rng(9).standard_normal(counts.shape)
    lit = rng.poisson(counts / SENSOR.gain * response) * SENSOR.gain
    raw = np.rint(lit + rng.normal(64, SENSOR.read * SENSOR.gain, counts.shape))
    return np.clip(raw, 0, 4095).astype(np.uint16)


def write(folder, name, frame):
    folder.mkdir(exist_ok=True)
    tifffile.imwrite(folder / name, frame, photometric="minisblack")


def test_the_papers_85_percent():
    # RADIOMETRY: PRNU 1.9 %, 10 % non-uniformity, 1 % drift, one pixel in a million.
    assert 0.854 <= safe_mean(12_000) <= safe_mean(45_000) <= 0.863


@pytest.mark.parametrize("chance", [1e-3, 1e-4])
def test_the_safe_mean_saturates_as_rarely_as_it_says(chance):
    rng, full = np.random.default_rng(1), 30_000
    share = safe_mean(full, prnu=0.019, unevenness=0.1, chance=chance)
    brightest = share * full * 1.05 * 1.01 * (1 + rng.normal(0, 0.019, 2_000_000))
    clipped = np.mean(rng.poisson(brightest) > full)
    # Shot noise is taken at the mean, not at the brightest place: a little more than `chance`.
    assert 0.5 * chance < clipped < 2 * chance


def test_stops_left_and_clipped_share_by_hand():
    frame = np.full((64, 64), 1064.0)
    frame[0, :16] = 4095
    found = read_channel(frame, black=64.0, saturation=4095.0)
    assert found.clipped == 16 / 4096
    assert found.stops_left == 0.0
    assert read_channel(frame[1:], black=64.0, saturation=4064.0).stops_left == 2.0


def test_following_the_advice_brings_the_white_there_and_clips_nothing():
    rng = np.random.default_rng(2)
    first = read_channel(white(5000, 0.1, rng), black=64.0, saturation=4095.0)
    advice = advise(first, SENSOR, exposure_s=0.1)
    second = read_channel(white(5000, advice.time_s, rng), black=64.0, saturation=4095.0)
    assert second.mean / second.room == pytest.approx(advice.target, rel=0.01)
    assert second.clipped == 0
    assert 0 < second.stops_left < 0.15


def test_predicted_snr_is_what_the_longer_exposure_has():
    rng = np.random.default_rng(3)
    advice = advise(
        read_channel(white(5000, 0.1, rng), black=64.0, saturation=4095.0), SENSOR, exposure_s=0.1
    )
    frame = white(5000, advice.time_s, rng).astype(float) - 64
    flat = frame / (5000 * advice.time_s * TILT)
    assert flat.mean() / flat.std() == pytest.approx(
        snr_at(advice, SENSOR, advice.factor), rel=0.02
    )


def test_the_channel_that_saturates_first_and_the_poorest():
    rng = np.random.default_rng(5)
    frame = white(20_000, 0.1, rng, colours=(0.5, 1.0, 1.0, 0.25))
    readings = [
        read_channel(frame[y::2, x::2], black=64.0, saturation=4095.0, channel=name)
        for name, y, x in (("R", 0, 0), ("G", 0, 1), ("B", 1, 1))
    ]
    first, poorest = limiting([advise(r, SENSOR) for r in readings])
    assert (first.reading.channel, poorest.reading.channel) == ("G", "B")


def test_iso_helps_only_where_rounding_hides_the_shadows():
    assert judge_iso(1.5, dark_noise_dn=0.2).startswith("No: expose 1.5 stops")
    assert judge_iso(0.0, dark_noise_dn=0.2).startswith("Only if")
    assert judge_iso(0.0, dark_noise_dn=2.0).startswith("No: the white fills")
    assert "2.0 stops longer" in judge_iso(0.0, dark_noise_dn=2.0, iso=400)


def test_a_stack_of_a_white_tells_its_prnu_and_one_shot_does_not(tmp_path):
    rng = np.random.default_rng(12)
    for shot in range(3):
        write(tmp_path / "white", f"{shot}_0.5s.tif", white(4000, 0.5, rng))
    one = advise_frames(
        [tmp_path / "white" / "0_0.5s.tif"], black=64.0, saturation=4095, pattern="RGGB"
    )[0]
    assert not one.prnu_known and one.sensor.prnu == 0.01 and "assumed" in advice_text([one])
    found = advise_frames([tmp_path / "white"], black=64.0, saturation=4095, pattern="RGGB")[0]
    assert found.prnu_known and found.sensor.prnu == pytest.approx(SENSOR.prnu, rel=0.05)
    assert "PRNU 1 % measured" in advice_text([found])


def test_bands_of_a_tunable_filter_get_a_time_each(tmp_path):
    rng = np.random.default_rng(6)
    for band, rate in ((450, 800), (550, 8000), (650, 20_000)):
        for shot in "ab":
            write(tmp_path / "white", f"{band}nm_100ms_{shot}.tif", white(rate, 0.1, rng))
    for shot in "ab":
        write(tmp_path / "dark", f"{shot}.tif", white(0, 0.1, rng))
    found = advise_frames([tmp_path / "white"], [tmp_path / "dark"], saturation=4095)
    assert [c.shot.wavelength for c in found] == [450, 550, 650]
    assert [c.shot.exposure_s for c in found] == [0.1] * 3
    full = 4095 - 64
    for c, rate in zip(found, (800, 8000, 20_000), strict=True):
        assert c.first.time_s * rate / full == pytest.approx(c.first.target, rel=0.01)
        assert c.sensor.gain == pytest.approx(0.1, rel=0.05)
    assert "450 nm takes longest" in advice_text(found)


def test_the_longest_exposure_that_does_not_clip_is_read(tmp_path):
    rng = np.random.default_rng(7)
    for ms in (50, 200, 800):
        write(tmp_path / "w", f"550nm_{ms}ms.tif", white(10_000, ms / 1000, rng))
    (found,) = advise_frames([tmp_path / "w"], black=64.0, bits=12)
    assert found.shot.exposure_s == 0.2


def quarter(folder, **tags):
    """A white at a quarter of a 12-bit camera's range, stored in 16 bits."""
    folder.mkdir(parents=True, exist_ok=True)
    frame = white(10_000, 0.1, np.random.default_rng(15))
    for shot in "ab":
        tifffile.imwrite(folder / f"{shot}.tif", frame, photometric="minisblack", **tags)
    assert frame.max() < 1300
    return folder


def stops_of(found):
    (channel,) = (advice.reading for advice in found.advices)
    return channel.stops_left


@pytest.mark.parametrize("given", [{"bits": 12}, {"saturation": 4095.0}])
def test_the_brightest_pixel_is_never_taken_for_the_full_scale(tmp_path, given):
    with pytest.raises(NoAdvice, match=r"--bits.*--saturation") as refused:
        advise_frames([quarter(tmp_path / "w")], black=64.0)
    (problem,) = refused.value.problems
    assert problem.code == "E_BITS" and problem.file.endswith("a.tif")
    (found,) = advise_frames([tmp_path / "w"], black=64.0, **given)
    assert stops_of(found) == pytest.approx(np.log2(4031 / 1080), abs=0.05)
    assert "fills" not in found.iso_advice and found.first.factor > 3
    (of_16,) = advise_frames([tmp_path / "w"], black=64.0, bits=16)
    assert stops_of(of_16) == pytest.approx(stops_of(found) + 4, abs=0.05)


def test_full_scale_comes_from_the_white_level_of_the_file(tmp_path):
    dng = (50717, "H", 1, 4095, True)  # WhiteLevel of DNG
    (found,) = advise_frames([quarter(tmp_path / "w", extratags=[dng])], black=64.0)
    assert found.full == 4095 and "file" in found.full_from


def test_full_scale_comes_from_the_campaign_that_the_frames_belong_to(tmp_path):
    quarter(tmp_path / "raw" / "white")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "cam" }\n[cameras.cam]\nkind = "bands"\n'
        'files = "raw/{target}/{shot}.tif"\nbands = ["a"]\nbits = 12\nblack = 64\n'
        '[targets]\nwhite = { names = "white" }\n'
    )
    (found,) = advise_frames([tmp_path / "raw" / "white"])
    assert found.full == 4095 and "campaign.toml" in found.full_from
    assert stops_of(found) == pytest.approx(np.log2(4031 / 1080), abs=0.05)
    result = CliRunner().invoke(app, ["plan", "exposure", str(tmp_path / "raw" / "white")])
    assert "4095" in result.output and "campaign.toml" in result.output


@pytest.mark.parametrize("pattern", ['"RGGB"', '[["a", "b"], ["b", "c"]]'])
def test_the_mosaic_comes_from_the_campaign_that_the_frames_belong_to(tmp_path, pattern):
    rng, folder = np.random.default_rng(17), tmp_path / "raw" / "white"
    folder.parent.mkdir()
    for shot in "123":
        frame = white(20_000, 0.1, rng, colours=(0.5, 1.0, 1.0, 0.25))
        write(folder, f"100ms_{shot}.tif", frame)
    (tmp_path / "campaign.toml").write_text(
        f'[campaign]\nreference = "cam"\n[cameras.cam]\nkind = "mosaic"\npattern = {pattern}\n'
        'files = "raw/{target}/{exposure}ms_{shot}.tif"\nbits = 12\nblack = 64\n'
        '[targets]\nwhite = { names = "white", reflectance = 0.98 }\n'
    )
    result = CliRunner().invoke(app, ["plan", "exposure", str(folder), "--json"])
    (found,) = json.loads(result.stdout)["bands"]
    means = {one["channel"]: one["mean"] for one in found["channels"]}
    names = "RGB" if "R" in pattern else "abc"
    assert means == pytest.approx(dict(zip(names, (1000, 2000, 500), strict=True)), rel=0.02)
    assert found["prnu_known"] and found["prnu"] == pytest.approx(SENSOR.prnu, rel=0.1)
    (given,) = advise_frames([folder], pattern="RGGB")
    assert found["recommended_s"] == pytest.approx(given.first.time_s)


def test_codes_that_pile_up_below_the_bits_are_the_full_scale(tmp_path):
    rng = np.random.default_rng(16)
    light = white(40_000, 0.1, rng)
    light = light * (1 - 0.25 * np.linspace(0, 1, light.shape[1]))
    write(tmp_path / "w", "a.tif", np.minimum(light, 3600).astype(np.uint16))
    with pytest.raises(NoAdvice) as refused:
        advise_frames([tmp_path / "w"], bits=12, black=64.0)
    assert refused.value.problems[0].code == "E_WHITE_SATURATED"


def test_codes_beyond_the_bits_that_are_given_are_refused(tmp_path):
    write(tmp_path / "w", "a.tif", white(10_000, 0.1, np.random.default_rng(15)) << 4)
    with pytest.raises(NoAdvice, match="--saturation") as refused:
        advise_frames([tmp_path / "w"], bits=12)
    assert refused.value.problems[0].code == "E_BITS"


def test_all_sixteen_bits_and_bytes_are_full_scales_of_their_own(tmp_path):
    frame = white(10_000, 0.1, np.random.default_rng(15))
    write(tmp_path / "deep", "a.tif", frame * 32)
    assert advise_frames([tmp_path / "deep"])[0].full == 65535
    write(tmp_path / "byte", "a.tif", (frame // 16).astype(np.uint8))
    assert advise_frames([tmp_path / "byte"])[0].full == 255


def test_frames_that_tell_no_time_are_refused_with_what_to_try(tmp_path):
    rng = np.random.default_rng(8)
    write(tmp_path / "over", "550nm_400ms.tif", white(90_000, 0.4, rng))
    with pytest.raises(NoAdvice, match=r"0\.1 s") as refused:
        advise_frames([tmp_path / "over"], bits=12)
    assert refused.value.problems[0].code == "E_WHITE_SATURATED"
    write(tmp_path / "off", "550nm_400ms.tif", white(0, 0.4, rng))
    with pytest.raises(NoAdvice, match="lamp") as refused:
        advise_frames([tmp_path / "off"], black=64.0, saturation=4095)
    assert refused.value.problems[0].code == "E_WHITE_DARK"


def test_frames_that_show_no_white_are_refused_where_one_is_asked_for(tmp_path):
    rng = np.random.default_rng(13)
    scene = white(20_000, 0.1, rng)
    scene[:, : scene.shape[1] // 2] = 80  # half of the field is black
    write(tmp_path / "scene", "550nm_100ms.tif", scene)
    with pytest.raises(NoAdvice, match="not an evenly lit white") as refused:
        advise_frames([tmp_path / "scene"], black=64.0, saturation=4095)
    assert refused.value.problems[0].code == "E_WHITE_UNEVEN"


def test_darks_of_another_size_and_time_are_left_alone(tmp_path):
    rng = np.random.default_rng(14)
    frame = white(20_000, 0.1, rng)
    for shot in "ab":
        write(tmp_path / "w", f"550nm_100ms_{shot}.tif", white(20_000, 0.1, rng))
        write(tmp_path / "dark", f"100ms_{shot}.tif", white(0, 0.1, rng))
        write(tmp_path / "dark", f"2s_{shot}.tif", white(0, 0.1, rng) + 300)
        write(tmp_path / "dark", f"100ms_cropped_{shot}.tif", frame[2:])
    (found,) = advise_frames([tmp_path / "w"], [tmp_path / "dark"], saturation=4095)
    assert found.first.reading.room == pytest.approx(4095 - 64, abs=1)
    assert found.sensor.gain == pytest.approx(0.1, rel=0.05)


def test_the_command_says_it_as_table_and_json(tmp_path):
    rng = np.random.default_rng(10)
    for shot in "ab":
        frame = white(20_000, 0.1, rng, colours=(0.5, 1.0, 1.0, 0.25))
        write(tmp_path / "w", f"{shot}.tif", frame)
    requested = ["plan", "exposure", str(tmp_path / "w"), "--pattern", "RGGB", "--time", "0.1"]
    requested += ["--bits", "12"]
    result = CliRunner().invoke(app, [*requested, "--black", "64"])
    assert result.exit_code == 0
    assert "G saturates first; B gets" in result.output
    assert "why " in result.output and "ISO: " in result.output
    report = json.loads(CliRunner().invoke(app, [*requested, "--black", "64", "--json"]).output)
    (band,) = report["bands"]
    assert band["saturates_first"] == "G"
    assert band["recommended_s"] == pytest.approx(0.1 * band["recommended_factor"])
    assert len(band["channels"]) == 3
