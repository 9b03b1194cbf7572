"""What files and tables beside them say of a capture: exposures, levels of black, whites of one object, a white's spectrum."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from cameras import (
    BLACK,
    LIGHT,
    RGGB,
    SHAPE,
    developed,
    drop,
    errors,
    frames,
    key,
    read_scan,
    referenced,
    text,
    tones,
    write,
    write_scan,
)
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from typer.testing import CliRunner

from levkas.building import build, summarise
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.cli import app
from levkas.stages import native_files

TONES = tones(SHAPE)[0]
KNOWN_BLACK = f"bits = 12\nblack = {BLACK:g}\n"
Y, X = np.indices(SHAPE)


# --- exposures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cube", "mirror"])
@pytest.mark.parametrize("said", ["integration_times_(ms)", "name", "manifest", "no unit"])
def test_exposures_of_scans_are_read_where_they_stand(tmp_path, kind, said):
    """Bands of the panel are exposed half, once and twice as long as those of the white, or all of them twice."""
    times = np.array([500, 1000, 2000]) if said.startswith("int") else np.array([2000] * 3)
    light = {"light": 1400.0, "truth": TONES[..., None] * times / 1000}
    if said == "no unit":
        times, light = np.array([1000] * 3), {}
    folder = write(tmp_path / "c", kind, keys=KNOWN_BLACK, **light)
    text('dark = "dark"\n', "")(folder)
    rows = ["file,exposure_s"]
    for name in ("white", "panel"):
        path, own = folder / f"raw/{name}.hdr", times if name == "panel" else [1000] * 3
        cube = read_scan(path)
        if said.startswith("int"):
            write_scan(path, cube, **{said: "{" + ", ".join(map(str, own)) + "}"})
        elif said == "no unit":
            write_scan(path, cube, exposure=40_000)
        elif said == "name":
            for suffix in (".hdr", ".raw"):
                old = path.with_suffix(suffix)
                old.rename(old.with_name(f"{name}_{own[0]}ms{suffix}"))
        rows.append(f"raw/{name}.hdr,{own[0] / 1000:g}")
    if said == "name":
        text("{target}.hdr", "{target}_{exposure}ms.hdr")(folder)
    if said == "manifest":
        (folder / "times.csv").write_text("\n".join(rows))
        key('manifest = "times.csv"')(folder)
    bias, error, _ = errors(developed(folder), kind)
    assert abs(bias) < 0.004 + 4 * error


def test_exposures_in_png_are_there_in_all_frames_or_in_none(tmp_path):
    """The panel was exposed twice as long as the white, with as many counts: half of its reflectance."""

    def png(folder, name, level, seconds):
        codes = np.random.default_rng(len(name)).normal(level, 5, (48, 64)).clip(0, 4095)
        exif = Image.Exif()
        if seconds:
            exif[0x8769] = {33434: IFDRational(round(1e6 * seconds), 10**6)}
        path = folder / f"raw/{name}_550nm.png"
        Image.fromarray(np.rint(codes).astype(np.uint16)).save(path, exif=exif)

    folder = write(tmp_path / "c", keys=KNOWN_BLACK)
    drop("*")(folder)
    text("{wavelength}nm_{shot}.tif", "{wavelength}nm.png")(folder)
    shots = (("dark", 60, 0.01), ("white", 2060, 0.01), ("panel", 2060, 0.02))
    for name, level, seconds in shots:
        png(folder, name, level, seconds)
    assert developed(folder).cube.values.mean() == pytest.approx(0.5, abs=2e-3)
    for name, level, seconds in shots:
        png(folder, name, level, None)
        (problem,) = developed(folder).problems
        assert (problem.code, problem.field) == ("E_EXPOSURES", "exposure")
        assert problem.file.endswith(f"{name}_550nm.png")
        png(folder, name, level, seconds)


# --- black --------------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [(60, 64, 66, 110), (60, 64, 66)], ids=["known", "odd"])
def test_black_of_each_sensel_is_that_of_the_file(tmp_path, levels):
    """A DNG's levels by phase; three of them are not understood, but darks or a declared level serve."""
    rng, black = (
        np.random.default_rng(3),
        np.tile([[60, 64], [66, 110]], (SHAPE[0] // 2, SHAPE[1] // 2)),
    )
    truth = 0.04 + 0.02 * np.sin(X / 17) * np.cos(Y / 23)
    tags = [
        (33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True), (50713, 3, 2, (2, 2), True),
        (50714, 4, len(levels), levels, True), (50717, 4, 1, 4095, True),
    ]  # fmt: skip
    folder = write(tmp_path / "c", "mosaic", keys="")
    for path in (folder / "raw").iterdir():
        light = {"d": 0.0, "w": 1.0, "p": truth}[path.name[0]]
        codes = np.rint(black + LIGHT * light + rng.normal(0, 2, SHAPE)).astype(np.uint16)
        tifffile.imwrite(path, codes, photometric=32803, extratags=tags, metadata=None)
    assert abs((developed(folder).cube.values - truth[..., None]).mean()) < 1e-4
    text('dark = "dark"\n', "")(folder)
    made = developed(folder)
    if len(levels) == 3:
        (problem,) = made.problems
        assert problem.code == "E_DARK_MISSING" or "panel_0" in problem.file
        return
    miss = made.cube.values - truth[..., None]
    assert abs(miss.mean((0, 1))).max() < 1e-4 and abs(miss[-20:].mean()) < 2e-4
    own = np.s_[::2, ::2, 0]
    assert 0.85 < (miss[own] / made.cube.sigma[own]).std() < 1.15


# --- whites -------------------------------------------------------------------------------------


def test_every_object_is_divided_by_its_own_white(tmp_path):
    """Two sessions under lights that differ, in a folder each."""
    for name, light in (("icon1", 3000.0), ("icon2", 1900.0)):
        write(tmp_path / name, light=light)
        for path in (tmp_path / name / "raw").glob("panel*"):
            path.rename(path.with_name(path.name.replace("panel", name)))
    said = (tmp_path / "icon1/campaign.toml").read_text().replace('["panel"]', '["icon1", "icon2"]')
    pattern = "raw/{target}_{wavelength}nm_{shot}.tif"
    said = said.replace(f'"{pattern}"', f'["{{target}}/{pattern}", "{{object}}/{pattern}"]')
    (tmp_path / "campaign.toml").write_text(said)
    for name in ("icon1", "icon2"):
        made = developed(tmp_path, name)
        assert abs(errors(made, "bands")[0]) < 0.004
        used = {frame.path.parts[-3] for s in made.capture.sensors for frame in (*s.dark, *s.white)}
        assert used == {name}


def test_each_object_is_divided_by_the_white_that_is_nearest_in_time(tmp_path):
    """Another object was captured between the two whites, of which the second has 10 % less light; the panel has 20 %."""
    folder = write(tmp_path / "c", shots=(2, 2, 1), drift=0.2)
    for path in [*(folder / "raw").glob("panel*")]:
        shutil.copy(path, path.with_name(path.name.replace("panel", "other")))
    text('["panel"]', '["panel", "other"]')(folder)
    for pattern, moment in (
        ("dark*", "08:00"), ("white*_0.tif", "09:00"), ("other*", "09:01"), ("white*_1.tif", "12:00"),
        ("panel*", "12:10"),
    ):  # fmt: skip
        frames(pattern, lambda c: c, datetime=f"2024:05:31 {moment}:00")(folder)
    made = developed(folder)
    assert errors(made, "bands")[0] == pytest.approx(0.8 / 0.9 - 1, abs=0.01)


NM = np.arange(380.0, 721.0, 5.0)
CURVES = np.exp(-(((NM[:, None] - np.array([600.0, 540.0, 455.0])) / 45.0) ** 2))
BOARD, LAMP = np.interp(NM, [400, 700], [0.80, 0.95]), np.interp(NM, [380, 720], [0.1, 1.0])


@pytest.mark.parametrize(
    ("board", "sensitivity", "most", "told"),
    [
        (BOARD, True, 0.004, ()),
        (BOARD, False, 0.086, ("sensitivity", "8.6 %")),
        (np.where(NM < 480, np.nan, BOARD), True, 0.1, ("B",)),
    ],
    ids=["known", "no sensitivities", "board not known in the blue"],
)
def test_a_white_is_weighted_by_sensitivity_and_light(tmp_path, board, sensitivity, most, told):
    observed = CURVES * LAMP[:, None]
    white = (BOARD @ observed / observed.sum(0))[RGGB[Y % 2, X % 2]]
    folder = write(tmp_path / "c", "mosaic", white='"white.csv"', truth=0.5 + 0 * TONES)
    frames("white*", lambda c: np.rint(BLACK + white * (c - BLACK)).astype("u2"))(folder)
    for name, table, head in (
        ("rgb", CURVES, "R,G,B"), ("white", board[:, None], "board"), ("lamp", LAMP[:, None], "power"),
    ):  # fmt: skip
        rows = [r for r in np.column_stack([NM, table]) if np.isfinite(r).all()]
        lines = [f"nm,{head}", *(",".join(f"{v:.6f}" for v in row) for row in rows)]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    if sensitivity:
        key('sensitivity = "rgb.csv"')(folder)
    with (folder / "campaign.toml").open("a") as file:
        file.write('[setups.default]\nspectrum = "lamp.csv"\n')
    made = developed(folder)
    off = np.abs(made.cube.values.mean((0, 1)) / 0.5 - 1).max()
    assert off < most and (off > 0.02) == (not sensitivity)
    assert made.told(*told) if told else made.words == []


# --- several faults at once ---------------------------------------------------------------------


def test_five_faults_of_a_campaign_file_are_told_at_once(tmp_path):
    folder = write(tmp_path / "c")
    for old, new in (
        ('reference = "cam"', 'reference = "cum"\nlicense = "CC0"'),
        ("bits = 12", 'black = "dark"\nscan = "mirror"'),
        ("reflectance = 1.0", 'reflectance = "board.csv"'),
    ):
        text(old, new)(folder)
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(folder)
    assert {p.field for p in refused.value.problems} == {
        "campaign.reference.camera", "campaign.license", "cameras.cam.black", "cameras.cam.scan",
        "targets.white.reflectance",
    }  # fmt: skip


def test_five_bad_frames_and_one_of_another_camera_are_told_in_one_report(tmp_path):
    folder = write(tmp_path / "c", shots=(1, 1, 1))
    raw = folder / "raw"
    whole = (raw / "panel_450nm_0.tif").read_bytes()
    bad = {
        "panel_450nm_0.tif": whole[:900],
        "panel_650nm_0.tif": b"",
        "white_450nm_0.tif": b"\x89HDF\r\n\x1a\n" + whole,
        "white_550nm_0.tif": b"no image",
        "dark_550nm_0.tif": whole[:7],
    }
    for name, data in bad.items():
        (raw / name).write_bytes(data)
    (folder / "irr").mkdir()
    (folder / "irr/panel.tif").write_bytes(b"no image")
    with (folder / "campaign.toml").open("a") as file:
        file.write('[cameras.irr]\nkind = "image"\nfiles = "irr/{target}.tif"\n')
    done = CliRunner().invoke(app, ["build", str(folder), "--json"])
    problems = json.loads(done.stdout)["problems"]
    assert done.exit_code == 1
    named = {Path(p["file"]).name for p in problems if p["file"]}
    assert named == {*bad, "panel.tif"} - {
        "white_550nm_0.tif"
    }  # it shares the reason of the other white
    assert all(p["found"] and p["expected"] and p["fix"] for p in problems)


# --- samples that are no bands ------------------------------------------------------------------


@pytest.mark.parametrize("extra", ["alpha", "equal", "unequal"])
def test_alpha_and_equal_samples_are_left_out_and_unequal_ones_are_refused(tmp_path, extra):
    folder = write(tmp_path / "c", shots=(1, 1, 1))
    for path in (folder / "raw").iterdir():
        codes = tifffile.imread(path)
        if extra == "alpha":
            samples = np.dstack([codes, np.full(SHAPE, 65535, np.uint16)])
            tifffile.imwrite(path, samples, photometric="minisblack", extrasamples=["unassalpha"])
        else:
            samples = np.dstack([codes] * 3)
            samples[..., 1] += extra == "unequal" and path.name.startswith("panel_550nm")
            tifffile.imwrite(path, samples, photometric="rgb")
    made = developed(folder)
    if extra == "unequal":
        assert "panel_550nm" in made.problems[0].file
    else:
        assert abs(errors(made, "bands")[0]) < 0.01


def test_templates_are_shared_by_objects_that_agree_and_compared_with_every_one(tmp_path):
    """The white was averaged, and kept, for an object that agrees with it; another object states another ISO."""
    folder = write(tmp_path / "c", iso=(100, 100))
    for path in [*(folder / "raw").glob("panel*")]:
        shutil.copy(path, path.with_name(path.name.replace("panel", "other")))
    frames("other*", lambda c: c, extratags=[(34855, "H", 1, 200, True)])(folder)
    text('["panel"]', '["panel", "other"]')(folder)
    steps = summarise(build(folder)).stages
    ends = {
        s.key.object: (s.state, {p.code for p in s.problems})
        for s in steps
        if s.key.stage == "calibrate"
    }
    assert ends == {"panel": ("done", set()), "other": ("refused", {"E_FACTS"})}


def test_what_does_not_fit_in_memory_is_refused_and_the_other_camera_goes_on(tmp_path, monkeypatch):
    folder = write(tmp_path / "c", "cube", referenced)
    needed = native_files.SAMPLE_BYTES * 3 * SHAPE[0] * SHAPE[1]
    for free, state in ((needed - 1.0, "refused"), (needed + 0.0, "done")):
        monkeypatch.setattr(native_files, "memory_bound", lambda free=free: free)
        ended = {(s.key.camera, s.key.stage): s for s in summarise(build(folder)).stages}
        assert ended["cam", "calibrate"].state == state
        assert ended["photo", "calibrate"].state in ("done", "fresh")
        assert [p.code for p in ended["cam", "calibrate"].problems] == ["E_MEMORY"][
            : state == "refused"
        ]


def test_noise_that_a_report_tells_of_a_mosaic_is_that_of_its_sensels(tmp_path):
    """The scene differs from sensel to sensel: interpolation knows nothing of it."""
    r, gain, read = np.array([0.3, 0.7]), 0.25, 2.5
    scene = np.random.default_rng(3).choice(r, SHAPE)
    folder = write(tmp_path / "c", "mosaic", truth=scene, shots=(4, 4, 1))
    assert summarise(build(folder)).ok
    page = (folder / "database/objects/panel/report.html").read_text()
    cells = re.findall(r"<td[^>]*>(.*?)</td>", page[page.index("Median SNR") :], re.DOTALL)
    noise_told, snr_told = (float(cell.split()[0]) for cell in cells[1:3])
    # One shot over the mean of four whites: u² = (v + r² v_white/4) / light², half of the sensels at each.
    variance = gain * LIGHT * r + read**2 + r**2 * (gain * LIGHT + read**2) / 4
    noise = np.sqrt(variance) / LIGHT
    assert noise[0] * 0.95 < noise_told < noise[1] * 1.05
    assert (r / noise)[0] * 0.95 < snr_told < (r / noise)[1] * 1.05
