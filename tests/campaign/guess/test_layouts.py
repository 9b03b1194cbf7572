"""Layouts of scanners, multispectral cameras and tethered sessions: what `look` proposes is found, and built right."""

import re
import unicodedata

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

import levkas
from levkas.building import build
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import look, write_campaign

SHAPE = (120, 160)
WAVES = np.arange(400.0, 701, 100)


def painting(seed, bands=1, shape=SHAPE):
    """Strokes whose shades drift from band to band, shares of one, (height, width, bands)."""
    rng = np.random.default_rng(seed)
    first, last = (np.full(shape, 0.5, np.float32) for _ in range(2))
    for _ in range(160):
        x, y = rng.integers(0, shape[::-1]).tolist()
        end = int(x + rng.integers(-25, 25)), int(y + rng.integers(-25, 25))
        width, levels = int(rng.integers(2, 5)), rng.uniform(0.1, 0.9, 2)
        cv2.line(first, (x, y), end, float(levels[0]), width)
        cv2.line(last, (x, y), end, float(0.6 * levels[0] + 0.4 * levels[1]), width)
    share = np.linspace(0, 1, bands) if bands > 1 else np.zeros(1)
    return first[..., None] * (1 - share) + last[..., None] * share


def frame(path, shares, *, full=3000.0, dtype=np.uint16):
    """Write shares of a scale above a black level of 100, with noise; the suffix gives the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(list(path.name.encode()))
    fall = 1 - 0.2 * np.linspace(-1, 1, np.shape(shares)[1]) ** 2
    counts = 100 + full * np.asarray(shares) * fall
    counts = counts + rng.normal(0, 4, counts.shape)
    values = (counts / (1 if dtype == np.uint16 else 16)).clip(0, None).round().astype(dtype)
    if path.suffix.lower() in (".tif", ".tiff"):
        tifffile.imwrite(path, values, photometric="minisblack", metadata=None)
    else:
        cv2.imwrite(str(path), values)


def picture(path, seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), (255 * painting(seed, 3)).astype(np.uint8))


def cube(path, shares, light=2500.0, *, dtype="<u2", suffix=".raw", **facts):
    """Write an ENVI cube of 12 bits, or of shares themselves."""
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(list(path.name.encode())).normal(0, 2, np.shape(shares))
    values = (
        np.asarray(shares) if dtype == "<f4" else (100 + light * np.asarray(shares) + noise).round()
    )
    lines, samples, bands = values.shape
    path.with_name(path.name + suffix).write_bytes(
        values.transpose(0, 2, 1).astype(dtype).tobytes()
    )
    keys = {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "interleave": "bil",
        "byte order": 0,
    }
    keys |= {"data type": 4 if dtype == "<f4" else 12, "header offset": 0, "tint": 20}
    keys |= {"wavelength": "{" + ", ".join(f"{w:g}" for w in WAVES) + "}", **facts}
    text = "".join(f"{k} = {v}\n" for k, v in keys.items())
    path.with_name(path.name + ".hdr").write_text(f"ENVI\n{text}")


def board(lines=24):
    return np.ones((lines, SHAPE[1], len(WAVES)))


def found(folder):
    """Write the proposal and find its captures; return it, and the captures by object and camera."""
    proposal = look(folder)
    write_campaign(proposal)
    captures, refusals = find_captures(load_campaign(folder))
    assert not refusals, refusals
    return proposal, {(c.object, c.camera): c for c in captures}


def camera_of(proposal):
    ((name, camera),) = proposal.to_dict()["cameras"].items()
    return name, camera


# --- scanners and tethered sessions -----------------------------------------------------------


def specim_iq(folder):
    """Two scans of a card, each with the white of another number that was taken under its own light."""
    truths = {"001": painting(1, 4), "002": painting(2, 4)}
    for (number, truth), light, ref in zip(truths.items(), (2500, 1700), (281, 282), strict=True):
        capture = folder / number / "capture"
        cube(capture / number, truth, light)
        cube(capture / f"DARKREF_{ref}", 0 * board(), light)
        cube(capture / f"WHITEREF_{ref}", board(), light)
        cube(
            folder / number / "results" / f"REFLECTANCE_{number}", truth, dtype="<f4", suffix=".dat"
        )
        picture(folder / number / "results" / f"RGBSCENE_{number}.png")
        picture(folder / number / f"{number}.png")
        (folder / number / "metadata").mkdir()
        (folder / number / "metadata" / f"{number}.xml").write_text("<x/>")
    return truths


def test_a_card_of_a_specim_iq_is_one_camera_whose_scans_have_their_own_whites(tmp_path):
    truths = specim_iq(tmp_path)
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert camera["kind"] == "cube"
    assert camera["files"] == ["{target}/capture/{target}.hdr", "{object}/capture/{target}_*.hdr"]
    assert proposal.to_dict()["targets"] == {
        "dark": "DARKREF", "white": "WHITEREF", "objects": ["001", "002"],
    }  # fmt: skip
    for (name, _), capture in captures.items():
        (white,) = capture.sensors[0].white
        assert white.path.parent.parent.name == name
    left_out = "\n".join(proposal.left_out)
    for name in ("001/001.png", "001/results/RGBSCENE_001.png", "001/results/REFLECTANCE_001.hdr"):
        assert name.rpartition("/")[0] in left_out
    steps = list(build(tmp_path))
    assert not [s for s in steps if s.state in ("refused", "failed")]
    database = levkas.open(tmp_path / "database")
    for name, truth in truths.items():
        made = np.asarray(database[name][camera_of(proposal)[0]])
        assert np.abs(made - truth).max() < 0.02


def test_folders_of_a_headwall_scanner_are_an_object_each(tmp_path):
    for seed, name in enumerate(("painting1", "painting2")):
        cube(tmp_path / name / "raw_0", painting(seed, 4), suffix="")
        cube(tmp_path / name / "darkReference", 0 * board(), suffix="")
        cube(tmp_path / name / "whiteReference", board(), suffix="")
        picture(tmp_path / name / "raw_0_rgb.png")
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert camera["files"] == ["{target}/raw_0.hdr", "{object}/{target}.hdr"]
    assert {name for name, _ in captures} == {"painting1", "painting2"}
    assert all(c.sensors[0].white[0].object == name for (name, _), c in captures.items())


def test_scans_of_a_hyspex_have_the_white_that_is_nearest_by_their_names_and_their_dark_is_unknown(
    tmp_path,
):
    for name, time in (("white", "1010"), ("icon1", "1015"), ("icon2", "1130"), ("white", "1145")):
        scan = board() if name == "white" else painting(len(name), 4)
        stem = f"{name}_VNIR_1800_SN00841_9998us_2019-05-10T{time}10_raw"
        cube(tmp_path / stem, scan, suffix=".hyspex")
    proposal, captures = found(tmp_path)
    assert any("HySpex keeps it" in text for text in proposal.unknown)
    whites = {name: c.sensors[0].white[0].path.stem[-10:-4] for (name, _), c in captures.items()}
    assert whites == {"icon1": "101010", "icon2": "114510"}


@pytest.mark.parametrize("own", ["{icon}_001.tif", "raw_001.tif", "IMG_0001.tif"])
def test_folders_of_a_tethered_session_are_an_object_each(tmp_path, own):
    for seed, icon in enumerate(("icon1", "saint")):
        folder = tmp_path / f"2024-05-3{seed}_{icon}"
        frame(folder / own.format(icon=icon), painting(seed)[..., 0])
        for shot in (1, 2):
            frame(folder / f"white_{shot:03}.tif", 0.95 * np.ones(SHAPE))
            frame(folder / f"dark_{shot:03}.tif", np.zeros(SHAPE))
    proposal, captures = found(tmp_path)
    assert len(proposal.cameras) == 1 and len(captures) == 2
    for (name, _), capture in captures.items():
        (sensor,) = capture.sensors
        assert (len(sensor.dark), len(sensor.white)) == (2, 2)
        assert {f.object for f in (*sensor.dark, *sensor.white)} == {name}
        assert all(name in str(f.path) for f in (*sensor.object, *sensor.dark, *sensor.white))
    names = {"icon1", "saint"} if "icon" in own else {"2024-05-30_icon1", "2024-05-31_saint"}
    assert {name for name, _ in captures} == names


def test_a_scan_alone_and_scans_of_several_days_are_found(tmp_path):
    truths = specim_iq(tmp_path / "card")
    for number, day in zip(truths, ("2024-05-30", "2024-05-31"), strict=True):
        (tmp_path / "days" / day).mkdir(parents=True)
        (tmp_path / "card" / number).rename(tmp_path / "days" / day / number)
    proposal, captures = found(tmp_path / "days")
    _, camera = camera_of(proposal)
    assert camera["files"] == [
        "*/{target}/capture/{target}.hdr",
        "*/{object}/capture/{target}_*.hdr",
    ]
    assert {name for name, _ in captures} == set(truths)
    _, alone = camera_of(look(tmp_path / "days/2024-05-30"))
    assert alone["files"] == ["{target}/capture/{target}.hdr", "{object}/capture/{target}_*.hdr"]


def test_darks_and_whites_in_folders_of_an_objects_folder_serve_it(tmp_path):
    for seed, icon in enumerate(("icon1", "icon2")):
        for shot in (1, 2):
            frame(tmp_path / icon / "white" / f"{shot}.tif", 0.95 * np.ones(SHAPE))
            frame(tmp_path / icon / "dark" / f"{shot}.tif", np.zeros(SHAPE))
            frame(tmp_path / icon / "raw" / f"{shot}.tif", painting(seed)[..., 0])
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert camera["files"] == ["{target}/raw/{shot}.tif", "{object}/{target}/*.tif"]
    assert {len(c.sensors[0].white) for c in captures.values()} == {2}


def test_objects_of_several_days_have_the_white_of_their_day(tmp_path):
    for day, icons in (("2024-05-30", ("icon1", "icon2")), ("2024-05-31", ("saint",))):
        frame(tmp_path / day / "dark_1.tif", np.zeros(SHAPE))
        frame(tmp_path / day / "white_1.tif", 0.95 * np.ones(SHAPE))
        for icon in icons:
            frame(tmp_path / day / f"{icon}_1.tif", painting(len(icon))[..., 0])
    proposal, captures = found(tmp_path)
    assert len(proposal.cameras) == 1 and len(captures) == 3
    for capture in captures.values():
        (sensor,) = capture.sensors
        assert {f.path.parent for f in sensor.white} == {f.path.parent for f in sensor.object}


@pytest.mark.parametrize(
    ("own", "template", "files"),
    [
        ("{}_raw.tif", "{}_{}.tif", ["{target}_raw.tif", "{object}_{target}.tif"]),
        ("{}.tif", "{1}_{0}.tif", ["{target}.tif", "{target}_{object}.tif"]),
        ("s_{}_550nm.tif", "s_{}_{}_550nm.tif", None),
    ],
)
def test_darks_and_whites_that_bear_the_names_of_objects_serve_these(
    tmp_path, own, template, files
):
    for seed, icon in enumerate(("icon1", "saint nicholas")):
        frame(tmp_path / own.format(icon), painting(seed)[..., 0])
        frame(tmp_path / template.format(icon, "white"), 0.95 * np.ones(SHAPE))
        frame(tmp_path / template.format(icon, "dark"), np.zeros(SHAPE))
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert files is None or camera["files"] == files
    for (name, _), capture in captures.items():
        frames = [*capture.sensors[0].dark, *capture.sensors[0].white]
        assert len(frames) == 2
        assert files is None or {f.object for f in frames} == {name}
        assert all(name.removeprefix("s_") in f.path.name for f in frames)


def test_cameras_with_darks_and_whites_of_their_own_stay_cameras(tmp_path):
    for seed, camera in enumerate(("d80", "monochrome")):
        frame(tmp_path / camera / "icon.tif", painting(seed)[..., 0])
        frame(tmp_path / camera / "white.tif", 0.95 * np.ones(SHAPE))
        frame(tmp_path / camera / "dark.tif", np.zeros(SHAPE))
    proposal, captures = found(tmp_path)
    assert set(captures) == {("icon", "d80"), ("icon", "monochrome")}
    assert "{object}" not in proposal.text


def test_a_picture_beside_scans_is_never_the_reference(tmp_path):
    for seed, name in enumerate(("icon1", "icon2", "icon3")):
        picture(tmp_path / name / "view.jpg", seed)
        if seed < 2:
            cube(tmp_path / name / "scan", painting(seed, 4))
            cube(tmp_path / name / "dark", 0 * board())
            cube(tmp_path / name / "white", board())
    proposal = look(tmp_path)
    reference = proposal.to_dict()["campaign"]["reference"]["camera"]
    assert proposal.to_dict()["cameras"][reference]["kind"] == "cube"


# --- names of bands ---------------------------------------------------------------------------

MEGAVISION = (
    "MB365UV",
    "MB450RB",
    "MB505Cy",
    "MB535Gr",
    "MB570Am",
    "MB625Rd",
    "MB700IR",
    "MB870IR",
)


@pytest.mark.parametrize(
    ("name", "bands", "files", "objects"),
    [
        (
            "0020_000003_{band}_{n:03}.tif",
            MEGAVISION,
            "{target}_MB{wavelength}*_*.tif",
            {"0020_000003"},
        ),
        ("f12r_{band}_{n:03}_F.tif", MEGAVISION, "{target}_MB{wavelength}*_*_F.tif", {"f12r"}),
        (
            "f12v_{band}N_2_R.tif",
            ("380", "450", "520", "650"),
            "{target}_{wavelength}N_2_R.tif",
            {"f12v"},
        ),
        ("icon_{band}.tif", ("365", "450", "700"), "{target}_{wavelength}.tif", {"icon"}),
    ],
)
def test_wavelengths_between_letters_are_read(tmp_path, name, bands, files, objects):
    page = painting(3, len(bands))
    for n, band in enumerate(bands):
        frame(tmp_path / name.format(band=band, n=n + 1), page[..., n])
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert (camera["kind"], camera["files"]) == ("bands", files)
    assert camera["wavelengths"] == [int(re.sub(r"\D", "", band)) for band in bands]
    assert {target for target, _ in captures} == objects


def test_pages_that_are_numbered_alone_are_an_object_each(tmp_path):
    for folio in (1, 2):
        page = painting(folio, len(MEGAVISION))
        for n, band in enumerate(MEGAVISION):
            frame(tmp_path / f"0020_00000{folio}_{band}_{n + 1:03}.tif", page[..., n])
    _, captures = found(tmp_path)
    assert {target for target, _ in captures} == {"0020_000001", "0020_000002"}
    assert all(len(capture.bands) == len(MEGAVISION) for capture in captures.values())


@pytest.mark.parametrize("folder", ["", "page12/"])
def test_bands_of_one_page_are_no_whites_though_its_ink_vanishes(tmp_path, folder):
    parchment, ink = 0.75 + 0.05 * painting(4)[..., 0], painting(5)[..., 0] < 0.3
    for n in range(8):
        shares = (parchment - 0.6 * ink * (1 - n / 7)) * (0.5 + 0.05 * n)
        frame(tmp_path / f"{folder}F{n + 1}s.png", shares, dtype=np.uint8)
    proposal, captures = found(tmp_path)
    ((target, _),) = captures
    assert target == (folder.rstrip("/") or tmp_path.name)
    assert "white" not in proposal.to_dict()["targets"]
    assert [b.label for b in captures[target, camera_of(proposal)[0]].bands] == [
        f"F{n}s" for n in range(1, 9)
    ]


def test_four_lenses_of_a_sequoia_are_sensors(tmp_path):
    for number in (0, 1):
        page = painting(6 + number, 4)
        for n, lens in enumerate(("GRE", "RED", "REG", "NIR")):
            frame(tmp_path / f"IMG_180323_10562{number}_000{number}_{lens}.TIF", page[..., n])
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert (camera["kind"], camera["files"]) == ("sensors", "IMG_{target}_{sensor}.TIF")
    assert {s["name"] for s in camera["sensors"]} == {"GRE", "RED", "REG", "NIR"}
    assert len(captures) == 2


@pytest.mark.parametrize(
    "bands",
    [
        ("R", "G", "B"),
        ("red", "green", "blue", "nir"),
        ("band1", "band2", "band10"),
        ("L1", "L2", "L3"),
    ],
)
@pytest.mark.parametrize("names", ["{}_{}.tif", "{}/{}.tif"])
def test_files_of_one_object_that_differ_in_a_colour_or_a_number_are_bands(tmp_path, names, bands):
    for seed, icon in enumerate(("icon1", "saint")):
        page = painting(seed, len(bands))
        for n, band in enumerate(bands):
            frame(tmp_path / names.format(icon, band), page[..., n])
    proposal, captures = found(tmp_path)
    _, camera = camera_of(proposal)
    assert camera["files"] == names.format("{target}", "{band}")
    assert set(camera["bands"]) == set(bands)
    assert {target for target, _ in captures} == {"icon1", "saint"}


@pytest.mark.parametrize("names", [("recto", "verso"), ("F1", "F2", "F3"), ("f12_r", "f12_v")])
def test_files_that_show_other_things_are_objects_whatever_bands_their_names_could_count(
    tmp_path, names
):
    for seed, name in enumerate(names):
        frame(tmp_path / f"{name}.tif", painting(seed)[..., 0])
    assert set(look(tmp_path).objects) == set(names)


def test_what_names_do_not_decide_is_decided_by_fine_detail(tmp_path):
    page = painting(7, 3)
    for n, name in enumerate(("alpha", "beta", "gamma")):
        frame(tmp_path / "bands" / f"{name}.tif", page[..., n])
        frame(tmp_path / "objects" / f"{name}.tif", painting(10 + n)[..., 0])
    _, camera = camera_of(look(tmp_path / "bands"))
    assert (camera["kind"], camera["files"]) == ("bands", "../{target}/{band}.tif")
    assert look(tmp_path / "objects").objects == ("alpha", "beta", "gamma")


def test_what_nothing_decides_is_asked_and_either_answer_is_a_campaign(tmp_path):
    slope = np.linspace(0.3, 0.6, SHAPE[1]) * np.ones((SHAPE[0], 1))
    for n, name in enumerate(("alpha", "beta", "gamma")):
        frame(tmp_path / f"{name}.tif", (1 - 0.2 * n) * slope)
    proposal = look(tmp_path)
    assert "whether alpha, beta, gamma are bands of one object or objects" in proposal.unknown[0]
    write_campaign(proposal)
    with pytest.raises(CampaignInvalid, match="kind"):
        load_campaign(tmp_path)
    answers = []
    for what in (f"bands of {tmp_path.name}:", "an object each:"):
        blocks = rf"# {re.escape(what)}\n(?:#     .*\n)+"
        text = re.sub(blocks, lambda block: block[0].replace("#     ", ""), proposal.text)
        (tmp_path / "campaign.toml").write_text(text)
        captures, refusals = find_captures(load_campaign(tmp_path))
        assert not refusals
        answers.append((len(captures), len(captures[0].bands)))
    assert answers == [(1, 3), (3, 1)]


# --- whites that are none ---------------------------------------------------------------------


def test_a_white_that_shows_the_object_is_an_object(tmp_path):
    page = painting(8, 2)
    frame(tmp_path / "dark.tif", np.zeros(SHAPE))
    frame(tmp_path / "page_uv.tif", page[..., 0])
    frame(tmp_path / "page_white.tif", 0.5 + 0.5 * page[..., 1])  # under white light
    proposal = look(tmp_path)
    assert "white" not in proposal.to_dict()["targets"]
    assert any(
        "it shows what page_uv shows" in text or "it shows what" in text
        for text in proposal.unknown
    )


def test_a_board_that_leaves_a_part_of_the_view_to_the_painting_is_doubted(tmp_path):
    shares = painting(9)[..., 0]
    white = np.full(SHAPE, 0.95)
    white[:, 110:] = shares[:, 110:]
    for name, values in (("dark", 0 * shares), ("white", white), ("icon", shares)):
        frame(tmp_path / f"{name}.tif", values)
    proposal = look(tmp_path)
    assert proposal.to_dict()["targets"]["white"] == "white"
    assert any("whether the board fills the view of white" in text for text in proposal.unknown)


def test_a_bright_and_even_picture_of_an_object_is_no_white(tmp_path):
    for n, name in enumerate(("IMG_0001", "IMG_0002", "IMG_0003")):
        frame(tmp_path / f"{name}.tif", 0.9 - (0.03 if n == 2 else 0.6) * painting(20 + n)[..., 0])
    assert set(look(tmp_path).objects) == {"0001", "0002", "0003"}


# --- numbers of bands that darks and whites have, too -------------------------------------------

STUDIOS = {
    "German": ("Weißabgleich", "Schwarzbild"),
    "German, in short": ("hell", "dunkel"),
    "French": ("blanc", "noir"),
    "Italian": ("bianco", "nero"),
    "Russian": ("белый", "темновой"),
    "English": ("flat", "nolight"),
}


@pytest.mark.parametrize(
    ("studio", "form", "layout"),
    [*((studio, "NFC", "{0}_{1}") for studio in STUDIOS), ("German", "NFD", "{0}_{1}"),
     ("German", "NFD", "{0}/{0}_{1}"), ("English", "NFC", "{0}_W{1}"), ("French", "NFC", "{0}/{0}_{1}")],
)  # fmt: skip
def test_numbers_that_darks_and_whites_have_too_are_wavelengths(tmp_path, studio, form, layout):
    white, dark = STUDIOS[studio]
    shares = {white: board()[0:1].repeat(SHAPE[0], 0), dark: np.zeros((*SHAPE, 4))}
    shares |= {name: painting(i, 3) for i, name in enumerate(("Büste", "Tafel"))}
    for name, bands in shares.items():
        for i, centre in enumerate((385, 550, 940)):
            path = tmp_path / "raw" / layout.format(unicodedata.normalize(form, name), centre)
            frame(path.with_name(f"{path.name}.tif"), bands[..., i])
    _, captures = found(tmp_path)
    assert {name for name, _ in captures} == {"Büste", "Tafel"}
    for capture in captures.values():
        (sensor,) = capture.sensors
        assert [band.wavelength for band in sensor.bands] == [385, 550, 940]
        assert {f.band for f in sensor.white} == {f.band for f in sensor.dark} == {"385 nm", "550 nm", "940 nm"}  # fmt: skip


def test_exposures_that_darks_have_too_are_no_wavelengths(tmp_path):
    for name, share in (("dark", 0.0), ("white", 1.0), ("panel", painting(1)[..., 0])):
        for time in (400, 800):
            frame(tmp_path / f"{name}_{time}.tif", share * np.ones(SHAPE) * time / 800)
    assert "{wavelength}" not in look(tmp_path).text


# --- cubes in files of arrays -------------------------------------------------------------------


def write_hdf5(path, counts):
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["cube"], file["wavelengths"] = counts, WAVES


def write_mat(path, counts):
    savemat(path.with_suffix(".mat"), {"cube": counts, "wavelengths": WAVES})


@pytest.mark.parametrize("write", [write_hdf5, write_mat])
def test_cubes_in_files_of_arrays_are_scans_of_their_wavelengths(tmp_path, write):
    rng, truth = np.random.default_rng(4), painting(3, 4)
    (tmp_path / "scanner").mkdir()
    for name, share in (("dark", 0.0), ("white", 1.0), ("panel", truth)):
        counts = 90 + 3300 * share * np.ones((*SHAPE, 4)) + rng.normal(0, 4, (*SHAPE, 4))
        write(tmp_path / "scanner" / name, counts.round().astype(np.uint16))
    (tmp_path / "scanner/notes.mat").write_bytes(b"no arrays")
    proposal, captures = found(tmp_path)
    assert 'kind = "cube"' in proposal.text and list(captures) == [("panel", "scanner")]
    (sensor,) = captures["panel", "scanner"].sensors
    assert [band.wavelength for band in sensor.bands] == WAVES.tolist()
    list(build(tmp_path))
    layer = levkas.open(tmp_path / "database")["panel"]["scanner"]
    assert np.abs(layer.values - truth).mean() < 0.002
