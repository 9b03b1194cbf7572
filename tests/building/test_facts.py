"""Files of one camera that contradict each other: the values are right, or the capture is refused, or it is said."""

import itertools

import numpy as np
import pytest
import tifffile

from levkas.calibration.agreement import OF_ONE_NOISE
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.problems import Refused
from levkas.readers.compared_facts import FACTS_BY_NAME
from levkas.readers.frames import read_facts
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

SIZE, BLACK, LIGHT, NOISE, TRUTH = (40, 48), 64.0, 1500.0, 3.0, 0.5
ISO, STOP, FOCAL, LENS, SERIAL, BALANCE = 34855, 33437, 37386, 42036, 42033, 41987
MAKE, GAIN_CONTROL = 271, 41991
MODEL, TIME, XMP, BLACK_LEVEL, WHITE_LEVEL, PATTERN = 272, 33434, 700, 50714, 50717, 33422
RECOMMENDED, EXPOSURE_INDEX, APERTURE = 34866, 41493, 37378
RATIONAL = {STOP, FOCAL, TIME, APERTURE, EXPOSURE_INDEX}


# --- files that state facts -----------------------------------------------------------------------


def tags_of(stated):
    """Tags of a TIFF, as tifffile takes them; strings and rationals as cameras write them."""
    for tag, value in stated.items():
        if not isinstance(tag, int):
            continue
        if isinstance(value, str | bytes):
            yield (tag, 1 if isinstance(value, bytes) else 2, len(value), value, True)
        elif tag in RATIONAL:
            yield (tag, 5, 1, (round(value * 1000), 1000), True)
        else:
            yield (tag, 3, np.size(value), value, True)


def write_tiff(path, codes, stated):
    tifffile.imwrite(
        path.with_suffix(".tif"), codes, photometric="minisblack", metadata=None,
        extratags=list(tags_of(stated)),
    )  # fmt: skip


def write_rgb(path, codes, stated):
    tags = list(tags_of(stated))
    codes = np.stack([codes, codes, codes], -1)
    tifffile.imwrite(
        path.with_suffix(".tif"), codes, photometric="rgb", metadata=None, extratags=tags
    )


def write_dng(path, codes, stated):
    own = {BLACK_LEVEL: int(BLACK), WHITE_LEVEL: 4095, PATTERN: b"\0\1\1\2", **stated}
    tags = [
        (50706, 1, 4, b"\1\4\0\0", True), (50707, 1, 4, b"\1\1\0\0", True),
        (50708, 2, 0, "Case", True), (33421, 3, 2, (2, 2), True),
        (50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, 3, 1, 21, True), (50728, 5, 3, (1, 1, 1, 1, 1, 1), True), *tags_of(own),
    ]  # fmt: skip
    tifffile.imwrite(
        path.with_suffix(".dng"), codes, photometric=32803, extratags=tags, metadata=None
    )


def write_envi(path, codes, stated):
    code = {"uint8": 1, "int16": 2, "uint16": 12, "float32": 4}[codes.dtype.name]
    cube = np.stack([codes, codes, codes], -1) if codes.ndim == 2 else codes
    path.with_suffix(".raw").write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
    lines, samples, bands = cube.shape
    rows = {"lines": lines, "samples": samples, "bands": bands, "data type": code}
    rows |= {"interleave": "bil", "byte order": 0}
    rows |= {key: value for key, value in stated.items() if key not in ("dtype", "shift", "effect")}
    path.with_suffix(".hdr").write_text("ENVI\n" + "".join(f"{k} = {v}\n" for k, v in rows.items()))


# --- campaigns of which one file states something else ---------------------------------------------

FORMATS = {"tiff": write_tiff, "dng": write_dng, "envi": write_envi, "rgb": write_rgb}
KEYS = {
    "tiff": 'kind = "bands"\nfiles = "{target}_{shot}_{wavelength}nm.tif"\nblack = 64',
    "rgb": 'kind = "cube"\nscan = "mirror"\nfiles = "{target}_{shot}_*.tif"\nblack = 64',
    "dng": 'kind = "mosaic"\nfiles = "{target}_{shot}_*.dng"',
    "envi": 'kind = "cube"\nfiles = "{target}_{shot}_*.hdr"',
}
SCANS = ("envi", "rgb")
CAMPAIGN = """
[campaign]
reference = "cam"
[cameras.cam]
{keys}
{more}
[targets]
dark = "dark"
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""
LEVELS = {"dark": 0.0, "white": 1.0, "panel": TRUTH}
FRAMES = [("dark", 0), ("dark", 1), ("white", 0), ("white", 1), ("panel", 0), ("panel", 1)]


def codes_of(form, target, shot, stated):
    """Counts of a frame, changed as what it states does to them."""
    rng = np.random.default_rng([shot, *target.encode()])
    counts = LIGHT * LEVELS[target] + rng.normal(0, NOISE, SIZE)
    codes = np.rint(stated.get("effect", 1.0) * counts + BLACK)
    if stated.get("dtype") == "uint8":
        return np.rint(codes / 16).clip(0, 255).astype(np.uint8)
    codes = codes.clip(0, 4095) * 2 ** stated.get("shift", 0)
    return codes.astype(stated.get("dtype", "uint16"))


def make(folder, form, statements, more=""):
    """Write a campaign; `statements` by (target, shot) or target, else by ``"all"``."""
    folder.mkdir()
    for target, shot in FRAMES:
        if form in SCANS and (target, shot) == ("panel", 1):
            continue  # it would be a strip
        own = statements.get((target, shot), statements.get(target, {}))
        stated = {**statements.get("all", {}), **own}
        path = folder / f"{target}_{shot}_550nm"
        FORMATS[form](path, codes_of(form, target, shot, stated), stated)
    keys = KEYS[form] if "black" not in more else KEYS[form].partition("\nblack")[0]
    (folder / "campaign.toml").write_text(CAMPAIGN.format(keys=keys, more=more))
    return folder


def developed(folder):
    campaign = load_campaign(folder)
    (capture,), refused = find_captures(campaign)
    assert not refused, refused
    native = develop(capture, campaign, TemplateCache(folder))
    (cube,) = native.cubes.values()
    return cube, native.warnings


def outcome(folder):
    """``"refused"`` with its problems, or ``"right"`` or ``"wrong"`` with its warnings."""
    try:
        cube, warnings = developed(folder)
    except Refused as refused:
        return "refused", refused.problems
    miss = np.median(cube.values, (0, 1)) - TRUTH
    return "right" if np.abs(miss).max() < 0.01 else "wrong", warnings


XMP_OF_BAND = '<x Camera:CentralWavelength="{}" Camera:BandName="{}"/>'
CONTRADICTIONS = [
    ("tiff", "iso", {ISO: 100}, {ISO: 200, "effect": 2.0}),
    ("tiff", "f_number", {STOP: 5.6}, {STOP: 8.0, "effect": 0.5}),
    ("tiff", "focal_length", {FOCAL: 35.0}, {FOCAL: 50.0, "effect": 0.9}),
    ("tiff", "lens", {LENS: "AF 35/2"}, {LENS: "AF 50/1.8", "effect": 0.9}),
    ("dng", "model", {MODEL: "D80"}, {MODEL: "D90", "effect": 1.2}),
    ("dng", "serial", {SERIAL: "1234"}, {SERIAL: "1235", "effect": 1.1}),
    ("tiff", "make", {MAKE: "NIKON"}, {MAKE: "Canon", "effect": 1.2}),
    ("tiff", "gain", {GAIN_CONTROL: 0}, {GAIN_CONTROL: 2, "effect": 2.0}),
    ("tiff", "sample_type", {}, {"dtype": "uint8"}),
    ("tiff", "black", {BLACK_LEVEL: 64}, {BLACK_LEVEL: 256}),
    ("tiff", "saturation", {WHITE_LEVEL: 4095}, {WHITE_LEVEL: 16383, "effect": 2.0}),
    ("dng", "bits", {WHITE_LEVEL: 4095}, {WHITE_LEVEL: 16383, "effect": 2.0}),
    ("dng", "pattern", {PATTERN: b"\0\1\1\2"}, {PATTERN: b"\2\1\1\0"}),
    ("tiff", "code_spacing", {}, {"shift": 4}),
    ("tiff", "wavelengths", {XMP: XMP_OF_BAND.format(550, "G").encode()},
     {XMP: XMP_OF_BAND.format(600, "G").encode(), "effect": 0.8}),
    ("rgb", "white_balance", {BALANCE: 1}, {BALANCE: 0, "effect": 1.3}),
    ("envi", "iso", {"iso": 100}, {"iso": 200, "effect": 2.0}),
    ("envi", "f_number", {"aperture": "f/2.8"}, {"aperture": "f/4", "effect": 0.5}),
    ("envi", "model", {"sensor type": "FX10"}, {"sensor type": "FX17", "effect": 0.8}),
    ("envi", "binning", {"binning": "{1, 2}"}, {"binning": "{1, 1}", "effect": 0.5}),
    ("envi", "region", {"x start": "1"}, {"x start": "33"}),
    ("envi", "wavelengths", {"wavelength": "{450, 550, 650}"}, {"wavelength": "{500, 600, 700}", "effect": 0.8}),
    ("envi", "bands", {"band names": "{R, G, B}"}, {"band names": "{R, G, NIR}", "effect": 0.8}),
    # facts in another tag
    ("tiff", "iso", {EXPOSURE_INDEX: 100}, {EXPOSURE_INDEX: 200}),
    ("dng", "iso", {ISO: 65535, RECOMMENDED: 25600}, {ISO: 65535, RECOMMENDED: 51200}),
    ("tiff", "iso", {ISO: 100}, {RECOMMENDED: 200}),
    ("tiff", "f_number", {STOP: 5.6}, {APERTURE: 6.0}),
]  # fmt: skip
PLACES = {"white": "white", "dark": "dark", "object": ("panel", 1), "second white": ("white", 1)}
CASES = [
    (*case, place if case[0] not in SCANS or place != "object" else "white")
    for case, place in zip(CONTRADICTIONS, itertools.cycle(PLACES), strict=False)
]


@pytest.mark.parametrize(("form", "name", "base", "other", "place"), CASES)
def test_files_that_contradict_each_other_are_refused_with_both_named(
    tmp_path, form, name, base, other, place
):
    stated = {"dark": base, "white": base, "panel": base, PLACES[place]: other}
    found, said = outcome(make(tmp_path / "c", form, stated))
    role = place.removeprefix("second ")
    if role not in FACTS_BY_NAME[name].roles:
        assert found == "right", (found, said)
        return
    assert found == "refused", (found, said)
    problem = next(p for p in said if f'"{name}"' in p.fix)
    target = {"object": "panel_1"}.get(role, f"{role}_{int(place != role)}")
    assert problem.code == "E_FACTS" and target in problem.file


@pytest.mark.parametrize(("form", "name"), [("tiff", "iso"), ("dng", "bits"), ("envi", "bands")])
def test_a_contradiction_is_accepted_by_name_and_said(tmp_path, form, name):
    base, other = next(case[2:] for case in CONTRADICTIONS if case[:2] == (form, name))
    more = f"overrule = {sorted({name, 'bits', 'saturation'})}"  # of a DNG both are one tag
    _, said = outcome(make(tmp_path / "c", form, {"all": base, "white": other}, more))
    title = FACTS_BY_NAME[name].title
    assert any(f"{title}: " in w and "white_0" in w and "panel_0" in w for w in said), said


def test_every_fact_has_a_format_that_states_it():
    assert {name for _, name, *_ in CONTRADICTIONS} == FACTS_BY_NAME.keys()


# --- what is no contradiction -----------------------------------------------------------------------

ORDINARY = {
    "a model filled up with blanks": ("tiff", {MODEL: "NIKON D80"}, {MODEL: "Nikon D80   \0"}),
    "a white exported without EXIF": ("tiff", {ISO: 100, STOP: 8.0}, {ISO: 0, STOP: 0.0}),
    "another form of one stop": ("tiff", {STOP: 5.6}, {STOP: 5.657}),
    "lines of a push-broom camera": ("envi", {"y start": 1}, {"y start": 500}),
    "a region counted from 0": ("envi", {"x start": 1}, {"x start": 0}),
    "a camera that ENVI does not know": ("envi", {"sensor type": "FX10"}, {"sensor type": "Unknown"}),
    "wavelengths rounded to nm": (
        "envi", {"wavelength": "{397.3, 400.1, 402.9}"}, {"wavelength": "{397, 400, 403}"},
    ),
    "a field that one header lacks": (
        "envi", {"gain": 2, "gain mode": "high"}, {"gain": "2.0", "gain mode": ""},
    ),
    "signed codes": ("envi", {}, {"dtype": "int16"}),
    "one stop in two tags": ("tiff", {STOP: 5.6}, {APERTURE: 4.97}),
    "one ISO in two tags": ("dng", {ISO: 100}, {RECOMMENDED: 100}),
    "one maker in two ways": ("tiff", {MAKE: "NIKON CORPORATION"}, {MAKE: "Nikon"}),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "place"), [*zip(ORDINARY, itertools.cycle(["white", "dark"]), strict=False)]
)
def test_what_vendors_write_is_no_contradiction(tmp_path, name, place):
    form, base, other = ORDINARY[name]
    stated = {"dark": base, "white": base, "panel": base, place: other}
    found, said = outcome(make(tmp_path / "c", form, stated))
    assert found == "right", (found, said)
    assert not [w for w in said if "_0_550nm" in w], said


@pytest.mark.parametrize(
    ("form", "white", "value"),
    [("envi", {"dtype": "float32"}, "float32"), ("dng", {BLACK_LEVEL: 65}, "65")],
)
def test_an_averaged_white_and_a_level_measured_for_each_frame_are_taken_and_said(
    tmp_path, form, white, value
):
    found, said = outcome(make(tmp_path / "c", form, {"white": white}))
    assert found == "right"
    assert any(f": {value} in white_0" in w for w in said), said


def rewritten(folder, target, change):
    """Write the shots of a target again."""
    for path in sorted(folder.glob(f"{target}_*.tif")):
        codes = tifffile.imread(path)
        path.unlink()
        write_tiff(path, change(codes), {})
    return folder


OTHER_CODES = {
    "fractions": lambda codes: (codes / 4095).astype(np.float32),
    "twice": lambda codes: codes * 2,
    "stretched to 16 bits": lambda codes: codes * 16 + codes // 256,
    "sixteen times, as floats": lambda codes: (codes * 16).astype(np.float32),
}


@pytest.mark.parametrize(
    ("form", "target"),
    [*zip(OTHER_CODES, itertools.cycle(["white", "dark", "panel"]), strict=False)],
)
def test_codes_of_another_scale_are_refused(tmp_path, form, target):
    folder = rewritten(make(tmp_path / "c", "tiff", {}), target, OTHER_CODES[form])
    found, said = outcome(folder)
    assert found == "refused"
    assert [p.code for p in said if "code_spacing" in p.fix], said


def test_floats_below_one_count_beside_floats_of_counts_are_no_contradiction(tmp_path):
    # Averages less their bias: the dark lies about 0, on both sides.
    folder = make(tmp_path / "c", "tiff", {})
    for target in LEVELS:
        level = np.random.default_rng(3).normal(0, 0.2, SIZE)
        rewritten(folder, target, lambda codes, level=level: (codes - BLACK + level).astype("f4"))
    rewritten(folder, "dark", lambda codes: (codes / 20).astype(np.float32))
    text = (folder / "campaign.toml").read_text().replace("black = 64", "")
    (folder / "campaign.toml").write_text(text)
    assert outcome(folder)[0] == "right"


@pytest.mark.parametrize(
    ("name", "base", "other"),
    [
        ("iso", {ISO: 100}, {ISO: 200, "effect": 2.0}),
        ("saturation", {WHITE_LEVEL: 4095}, {WHITE_LEVEL: 16383, "effect": 2.0}),
        ("model", {MODEL: "D80"}, {MODEL: "D90", "effect": 1.2}),
        ("sample_type", {}, {"dtype": "uint8"}),
    ],
)
def test_a_band_whose_files_agree_with_each_other_and_not_with_those_of_another(
    tmp_path, name, base, other
):
    folder = make(tmp_path / "c", "tiff", {"all": base})
    for target, shot in FRAMES:
        codes = codes_of("tiff", target, shot, other)
        write_tiff(folder / f"{target}_{shot}_850nm", codes, other)
    found, said = outcome(folder)
    fact = FACTS_BY_NAME[name]
    assert found == ("right" if fact.per_band else "refused"), said
    noted = any(f"{fact.title}: " in w and "panel_0_850nm" in w for w in said if found == "right")
    assert noted == (name in OF_ONE_NOISE)


def test_bands_may_have_their_own_iso_where_white_and_object_agree(tmp_path):
    stated = {"all": {ISO: 100}}
    folder = make(tmp_path / "c", "tiff", stated, "dark = []")
    for target, shot in FRAMES[2:]:
        own = {ISO: 400, "effect": 1.5}
        write_tiff(folder / f"{target}_{shot}_850nm", codes_of("tiff", target, shot, own), own)
    found, said = outcome(folder)
    assert found == "right"
    assert any("ISO: 400 in panel_0_850nm.tif" in w and "one noise model" in w for w in said)
    own = {ISO: 200, "effect": 0.75}
    write_tiff(folder / "white_0_850nm", codes_of("tiff", "white", 0, own), own)
    found, problems = outcome(folder)
    assert found == "refused" and len(problems) == 1, problems
    assert "white_0_850nm" in problems[0].file and "as panel_0_850nm" in problems[0].expected


# --- bands in another order -------------------------------------------------------------------------

LAMP = np.array([0.3, 1.0, 1.8, 2.4])
CENTRES = np.array([450.0, 550.0, 650.0, 750.0])
TIMES = [10, 20, 40, 80]


def scan(path, light, order, *, names=False, times=False):
    """A scan whose bands stand in an order; the codes of each are those of its wavelength."""
    rng = np.random.default_rng(sum(path.name.encode()))
    seconds = np.array(TIMES) / 40 if times else 1.0
    counts = light * 800 * LAMP * seconds + rng.normal(0, NOISE, (*SIZE, 4)) + BLACK + CENTRES / 10
    listed = [f"{CENTRES[i]:g}" for i in order]
    stated = {"band names" if names else "wavelength": "{" + ", ".join(listed) + "}"}
    if times:
        stated["tint"] = "{" + ", ".join(str(TIMES[i]) for i in order) + "}"
    write_envi(path, np.rint(counts[..., list(order)]).astype(np.uint16), stated)


def scans(folder, orders, more="", **options):
    folder.mkdir()
    truth = np.array([0.2, 0.4, 0.6, 0.8])
    for target, light in (("dark", 0.0), ("white", 1.0), ("panel", truth)):
        scan(folder / f"{target}_0_s", light, orders.get(target, range(4)), **options)
    (folder / "campaign.toml").write_text(CAMPAIGN.format(keys=KEYS["envi"], more=more))
    return folder, truth


@pytest.mark.parametrize(
    ("role", "order", "more", "options"),
    [
        ("white", (3, 2, 1, 0), "", {}),
        ("dark", (1, 3, 0, 2), "", {"names": True}),
        ("panel", (1, 3, 0, 2), 'scan = "mirror"', {"times": True}),
    ],
)
def test_bands_in_another_order_are_matched(tmp_path, role, order, more, options):
    folder, truth = scans(tmp_path / "c", {role: order}, more, **options)
    cube, said = developed(folder)
    expected = truth[list(order)] if role == "panel" else truth
    assert np.median(cube.values, (0, 1)) == pytest.approx(expected, abs=0.005)
    assert any("another order" in w for w in said)


# --- files and campaign.toml ------------------------------------------------------------------------

DECLARED = {
    "saturation": ("tiff", {WHITE_LEVEL: 4095}, "saturation = 3600", "4095 in", "3600 in"),
    "black": ("tiff", {BLACK_LEVEL: 128}, "black = 64", "128 in", "64 in campaign.toml"),
    "pattern": ("dng", {}, 'pattern = "BGGR"', "RGGB in", "BGGR in campaign.toml"),
}


@pytest.mark.parametrize("name", DECLARED)
def test_a_declaration_wins_and_both_values_are_said(tmp_path, name):
    form, stated, more, *texts = DECLARED[name]
    found, said = outcome(make(tmp_path / "c", form, {"all": stated}, more))
    assert found == "right"
    title = FACTS_BY_NAME[name].title
    assert any(title in w and all(text in w for text in texts) for w in said), said


def test_an_exposure_in_a_name_that_the_file_contradicts_is_said(tmp_path):
    folder = make(tmp_path / "c", "tiff", {"all": {TIME: 0.02}}, 'overrule = ["iso"]')
    for path in folder.glob("*.tif"):
        path.rename(path.with_name(f"{path.stem}_40ms.tif"))
    toml = folder / "campaign.toml"
    toml.write_text(toml.read_text().replace("nm.tif", "nm_{exposure}ms.tif"))
    found, said = outcome(folder)
    assert found == "right"
    assert any("0.02 in panel_0" in w and "0.04 in its name" in w for w in said)
    assert any("`overrule`" in w and "iso" in w for w in said)  # which accepts nothing
    toml.write_text(toml.read_text().replace('["iso"]', '["f_numbr"]'))
    with pytest.raises(CampaignInvalid):
        load_campaign(folder)


def test_a_wavelength_in_a_name_that_the_file_contradicts_is_refused(tmp_path):
    stated = {XMP: XMP_OF_BAND.format(850, "NIR").encode()}
    found, said = outcome(make(tmp_path / "c", "tiff", {"all": stated}))
    assert found == "refused"
    assert "850 nm" in said[0].found and "550 nm" in said[0].expected
    accepted = make(tmp_path / "d", "tiff", {"all": stated}, 'overrule = ["wavelengths"]')
    found, said = outcome(accepted)
    assert found == "right" and any("850 nm" in w for w in said)


# --- other roles and kinds --------------------------------------------------------------------------


RED_EDGE = """
[campaign]
reference = "rededge"
[cameras.rededge]
kind = "sensors"
files = "{folder}/IMG_{{target}}_{{sensor}}.tif"
{sensors}
[targets]
dark = []
white = {{ names = "0000", reflectance = 0.5 }}
objects = ["0001"]
"""


def test_a_real_camera_that_chose_another_iso_for_two_of_its_bands(real_data, tmp_path):
    """exiftool: ISO 100 of the panel in every band, 200 of the orchard in IMG_0001_3 and IMG_0001_5."""
    sensors = "".join(f'[[cameras.rededge.sensors]]\nname = "{i}"\n' for i in range(1, 6))
    folder = (real_data / "rededge-5lens").as_posix()
    (tmp_path / "campaign.toml").write_text(RED_EDGE.format(folder=folder, sensors=sensors))
    campaign = load_campaign(tmp_path)
    (capture,), _ = find_captures(campaign)
    with pytest.raises(Refused) as refused:
        develop(capture, campaign, TemplateCache(tmp_path))
    found = [(p.field, p.file.rpartition("/")[2], p.found) for p in refused.value.problems]
    assert found == [("ISO", f"IMG_0000_{n}.tif", "100") for n in (3, 5)]
    facts = read_facts(f"{folder}/IMG_0001_3.tif")
    assert (facts.f_number, facts.focal_mm, facts.serial) == (2.8, 5.5, "1777777")
