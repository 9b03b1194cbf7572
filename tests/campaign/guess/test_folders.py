"""Folders as studios leave them: the proposal of `look` is built as it stands."""

import cv2
import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from levkas.building import build
from levkas.campaign.guess import LookRefused, look, write_campaign
from levkas.core.cube import Flag
from levkas.quality.targets.charts import CHARTS

SHAPE = (240, 330)
WAVES = (450, 550, 650)


def painting(seed=1, shape=SHAPE):
    """Strokes of a painting, shares of one."""
    rng = np.random.default_rng(seed)
    picture = np.full(shape, 0.3, np.float32)
    for _ in range(400):
        x, y, level = *rng.integers(0, shape[::-1]), rng.uniform(0.05, 0.9)
        end = int(x + rng.integers(-30, 30)), int(y + rng.integers(-30, 30))
        cv2.line(picture, (int(x), int(y)), end, float(level), int(rng.integers(2, 6)))
    return picture


def chart(shape=SHAPE):
    """A ColorChecker Classic by its luminances."""
    picture, known = np.full(shape, 0.3, np.float32), CHARTS["ColorChecker24"]
    picture[14:226, 14:316] = 0.02
    for (column, row), level in zip(known.centres.astype(int), known.luminances, strict=True):
        y, x = 20 + 51 * row, 20 + 49 * column
        picture[y : y + 43, x : x + 43] = level / np.max(known.luminances) * 0.9
    return picture


def light(shape=SHAPE):
    """A white under a light that falls off by a sixth."""
    return np.ones((shape[0], 1)) * (0.9 - 0.15 * np.linspace(-1, 1, shape[1]) ** 2)


def write(path, shares, *, bits=12, seed=0, **tags):
    """Write shares of the scale as counts above a black level, with noise; the suffix gives the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng, full = np.random.default_rng([seed, *path.name.encode()]), 2**bits - 1
    counts = 0.02 * full + 0.8 * full * np.asarray(shares, np.float64)
    counts += rng.normal(0, 0.5 + 0.002 * full, counts.shape)
    values = counts.clip(0, full).round().astype(np.uint8 if bits == 8 else np.uint16)
    if path.suffix == ".tif":
        kind = "minisblack" if values.ndim == 2 else "rgb"
        tifffile.imwrite(path, values, photometric=kind, metadata=None, **tags)
    else:
        cv2.imwrite(str(path), values)


def three(folder, dark, white, scene, *, suffix=".png"):
    for name, shares in ((dark, 0 * light()), (white, light()), (scene, painting() * light())):
        write(folder / f"{name}{suffix}", shares, bits=8)


def bands(folder, targets, pattern="{}_{}nm.tif"):
    shares = {"dark": 0 * light(), "white": light(), "icon": painting() * light()}
    for target in targets:
        for nm in WAVES:
            write(folder / pattern.format(target, nm), shares.get(target, chart()))


def built(folder):
    """Build the proposal as it stands; return it once nothing was refused."""
    proposal = look(folder)
    write_campaign(proposal)
    for step in build(folder):
        assert step.state not in ("refused", "failed"), step
    return proposal


@pytest.mark.parametrize(
    ("dark", "white", "scene"),
    [
        ("dark-field", "flat", "scene"),
        ("DarkField", "FlatField", "Icon"),
        ("dark_frame_01", "flat_frame_01", "object_01"),
        ("lens cap", "white card", "madonna"),
        ("Dunkelbild", "Weißbild", "Gemälde"),
        ("image noire", "image blanche", "tableau"),
        ("scena_scura", "campo_piatto", "dipinto"),
        ("zwart", "wit", "schilderij"),
        ("тёмный", "белый", "икона"),
        ("暗", "白", "画"),
    ],
)
def test_a_dark_a_white_and_a_scene_are_known_in_any_language(tmp_path, dark, white, scene):
    three(tmp_path, dark, white, scene)
    targets = look(tmp_path).to_dict()["targets"]
    plain = [targets["dark"], targets["white"], *targets["objects"]]
    assert plain == [name.removesuffix("_01") for name in (dark, white, scene)]


def test_names_of_paintings_are_no_colours(tmp_path):
    write(tmp_path / "dark.png", 0 * light(), bits=8)
    write(tmp_path / "white.png", light(), bits=8)
    write(tmp_path / "madonna_nera.png", painting(1) * light(), bits=8)
    write(tmp_path / "bianca.png", painting(2) * light(), bits=8)
    assert look(tmp_path).objects == ("bianca", "madonna_nera")


def test_a_dark_painting_beside_a_white_is_no_dark(tmp_path):
    write(tmp_path / "white.png", light(), bits=8)
    write(tmp_path / "night.png", 0.06 * painting(1), bits=8)
    write(tmp_path / "day.png", painting(2) * light(), bits=8)
    assert look(tmp_path).objects == ("day", "night")


@pytest.mark.parametrize(
    ("pattern", "bits", "files"),
    [
        ("colorchecker_{}nm.png", 8, "{target}_{wavelength}nm.png"),
        ("Color Checker {}nm.png", 8, "{target} {wavelength}nm.png"),
        ("ColorCheckerClassic_{}.tif", 12, "{target}_{wavelength}.tif"),
        ("{}nm/macbeth.tif", 12, "{wavelength}nm/{target}.tif"),
        ("Farbkarte/F{}.png", 8, "{target}/{band}.png"),
    ],
)
def test_a_chart_through_several_filters_alone_is_a_campaign(tmp_path, pattern, bits, files):
    for nm in WAVES:
        write(tmp_path / pattern.format(nm), chart(), bits=bits)
    proposal = built(tmp_path)
    (camera,), targets = proposal.to_dict()["cameras"].values(), proposal.to_dict()["targets"]
    assert (camera["kind"], camera["files"]) == ("bands", files)
    assert set(targets) == {"charts"} and set(targets["charts"].values()) == {"ColorChecker24"}
    assert list((tmp_path / "database/charts").rglob("*.json"))


@pytest.mark.slow
def test_charts_alone_of_a_raw_camera_and_a_photograph_are_a_campaign(tmp_path):
    tags = [
        (33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True),
        (50706, "B", 4, bytes([1, 4, 0, 0]), True), (50708, "s", 0, "Plate camera", True),
        (50717, "H", 1, 4095, True), (50778, "H", 1, 21, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]  # fmt: skip
    write(tmp_path / "raw.tif", chart())
    codes = tifffile.imread(tmp_path / "raw.tif")
    (tmp_path / "raw.tif").unlink()
    (tmp_path / "d80").mkdir()
    raw = tmp_path / "d80/macbeth.dng"
    tifffile.imwrite(raw, codes, photometric=32803, extratags=tags, metadata=None)
    write(tmp_path / "phone/macbeth.jpg", np.repeat(chart()[..., None], 3, 2), bits=8)
    proposal = built(tmp_path)
    kinds = {name: c["kind"] for name, c in proposal.to_dict()["cameras"].items()}
    assert kinds == {"d80": "mosaic", "phone": "image"}


def test_charts_with_darks_and_whites_of_their_own_are_calibrated(tmp_path):
    bands(tmp_path, ("dark", "white", "macbeth"))
    built(tmp_path)
    cube = tifffile.imread(tmp_path / "database/charts/macbeth" / f"macbeth_{tmp_path.name}.tif")
    white = np.asarray(cube).reshape(len(WAVES), *SHAPE)[:, 20 + 51 * 3 + 10, 30]
    assert white == pytest.approx(0.9 / light()[0, 30], rel=0.05)  # the chart was drawn evenly lit


@pytest.mark.slow
def test_a_target_may_be_chart_and_object_at_once(tmp_path):
    bands(tmp_path, ("dark", "white", "icon", "macbeth"))
    proposal = look(tmp_path)
    assert proposal.objects == ("icon",)
    text = proposal.text.replace('objects = ["icon"]', 'objects = ["icon", "macbeth"]')
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    assert all(step.state not in ("refused", "failed") for step in build(tmp_path))
    assert (tmp_path / "database/objects/macbeth").is_dir()
    assert (tmp_path / "database/charts/macbeth").is_dir()


@pytest.mark.slow
def test_previews_copies_and_leftovers_are_left_out_and_named(tmp_path):
    bands(tmp_path, ("dark", "white", "icon"))
    for nm in WAVES:
        write(tmp_path / f"icon_{nm}nm.jpg", painting() * light(), bits=8)
        write(tmp_path / "previews" / f"icon_{nm}nm.png", painting(1, (60, 80)), bits=8)
    for name in ("icon_550nm (1)", "icon_550nm_old", "icon_550nm - Copy", "test"):
        write(tmp_path / f"{name}.tif", painting(3))
    write(tmp_path / "overview of the studio.jpg", np.zeros((90, 120, 3)) + 0.5, bits=8)
    for name in (".DS_Store", "Thumbs.db", "README.txt", "._icon_550nm.tif"):
        (tmp_path / name).write_bytes(b"\0\5\x16\7")
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    proposal = built(tmp_path)
    (camera,) = proposal.to_dict()["cameras"].values()
    assert camera["files"] == "{target}_{wavelength}nm.tif"
    assert proposal.objects == ("icon",)
    left_out = "\n".join(proposal.left_out)
    for reason in (
        "icon_450nm.jpg and 2 more: by its name a preview of icon_450nm.tif",
        "previews/icon_450nm.png and 2 more: by its name a preview",
        "icon_550nm (1).tif: by its name a copy of icon_550nm.tif",
        "icon_550nm_old.tif: by its name a copy",
        "icon_550nm - Copy.tif: by its name a copy",
        "test.tif: its name has no wavelength",
        "overview of the studio.jpg: the object is overview of the studio by its name, and icon by that",
        "broken.tif",
    ):
        assert reason in left_out, reason


def test_jpegs_beside_raws_of_other_names_stay_a_camera(tmp_path):
    bands(tmp_path / "ms", ("dark", "white", "icon"))
    write(tmp_path / "photo/icon.jpg", np.repeat(painting()[..., None], 3, 2), bits=8)
    assert set(look(tmp_path).to_dict()["cameras"]) == {"ms", "photo"}


def test_flats_of_several_cameras_in_one_folder_find_theirs(tmp_path):
    for camera, shape in (("d80", SHAPE), ("nir", (200, 280))):
        write(tmp_path / f"flats/{camera}.tif", light(shape))
        write(tmp_path / camera / "dark.tif", 0 * light(shape))
        write(tmp_path / camera / "icon.tif", painting(1, shape) * light(shape))
    proposal = look(tmp_path)
    files = {name: camera["files"] for name, camera in proposal.to_dict()["cameras"].items()}
    assert files == {n: [f"{n}/{{target}}.tif", f"{{target}}/{n}.tif"] for n in ("d80", "nir")}
    assert proposal.to_dict()["targets"]["white"] == "flats"
    assert not any("refused" in text for text in proposal.unknown)


@pytest.mark.slow
def test_numbered_captures_are_known_by_what_they_show(tmp_path):
    shown = [0 * light(), 0 * light(), light(), light(), *(painting(s) * light() for s in (1, 2))]
    for number, shares in enumerate(shown, 1):
        write(tmp_path / f"IMG_{number:04}.tif", shares, seed=number)
    targets = built(tmp_path).to_dict()["targets"]
    assert (targets["dark"], targets["white"]) == (["0001", "0002"], ["0003", "0004"])
    flags = tifffile.imread(next((tmp_path / "database").rglob("0005*.flags.tif")))
    assert np.mean(np.asarray(flags) & int(Flag.SATURATED) > 0) < 0.01


def test_an_optical_picture_is_the_reference_of_an_infrared(tmp_path):
    rng = np.random.default_rng(4)
    for name in ("house_optical", "house_infrared"):
        texture = gaussian_filter(rng.random((90, 120)), 2) * 6 - 2.5
        write(tmp_path / f"{name}.png", np.clip(texture, 0.1, 0.9), bits=8)
    proposal = look(tmp_path)
    assert proposal.to_dict()["campaign"]["reference"]["camera"] == "optical"
    assert proposal.objects == ("house",) and not proposal.left_out


def test_folders_of_several_campaigns_are_told_apart(tmp_path):
    bands(tmp_path / "monday", ("dark", "white", "icon"))
    for name in ("saint", "feast"):
        write(tmp_path / f"archive/{name}.jpg", np.zeros((90, 120, 3)) + 0.5, bits=8)
    proposal = look(tmp_path)
    assert len(proposal.to_dict()["cameras"]) == 1
    assert any(
        "run `levkas look` on the folder of these alone" in line for line in proposal.left_out
    )


def test_darks_and_whites_alone_are_refused(tmp_path):
    bands(tmp_path, ("dark", "white"))
    with pytest.raises(LookRefused, match="darks or whites"):
        look(tmp_path)
