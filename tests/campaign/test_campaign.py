import copy
import re
import tomllib
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.campaign.campaign import CampaignInvalid, _validate, load_campaign
from levkas.campaign.schema.error_messages import GONE, TABLES

DOCS = Path(__file__).resolve().parents[2] / "docs" / "campaign.md"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SMALL = """
[campaign]
reference = { camera = "vis", band = "550 nm" }
[cameras.vis]
kind = "bands"
files = "raw/{target}/{wavelength}nm.tif"
"""


def written(folder, text):
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


def problems_of(folder, text):
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(written(folder, text))
    return refused.value.problems


def test_short_forms_mean_the_long_ones(tmp_path):
    long = SMALL + '[targets]\nwhite = { names = ["w"] }\n'
    short = (
        SMALL.replace('{ camera = "vis", band = "550 nm" }', '"vis:550 nm"')
        + '[targets]\nwhite = "w"\n'
    )
    a, b = (load_campaign(written(tmp_path, text)) for text in (long, short))
    assert a == b


def test_a_pattern_is_letters_or_rows_of_names(tmp_path):
    text = SMALL.replace('"bands"', '"mosaic"').replace("{wavelength}nm", "{shot}")
    for pattern, rows in (
        ('"rggb"', (("R", "G"), ("G", "B"))),
        ('[["B1", "B2"], ["B3", "B4"]]', (("B1", "B2"), ("B3", "B4"))),
    ):
        campaign = load_campaign(written(tmp_path, f"{text}pattern = {pattern}\n"))
        assert campaign.cameras["vis"].pattern == rows


def test_steps_of_wavelengths_have_both_ends(tmp_path):
    text = SMALL + "wavelengths = { start = 400, stop = 720, step = 10 }\n"
    centres = load_campaign(written(tmp_path, text)).cameras["vis"].centres
    assert (len(centres), centres[0], centres[-1]) == (33, 400.0, 720.0)


def test_a_misspelt_key_is_refused_with_the_one_that_was_meant(tmp_path):
    (problem,) = problems_of(tmp_path, SMALL.replace("files", "wavelenghts = [1]\nfiles"))
    assert problem.code == "E_KEY" and problem.field == "cameras.vis.wavelenghts"
    assert problem.fix == "Did you mean 'wavelengths'?"


def test_a_key_in_the_wrong_table_is_sent_home(tmp_path):
    (problem,) = problems_of(tmp_path, SMALL + "reject = 3\n")
    assert "[registration]" in problem.fix
    (problem,) = problems_of(tmp_path, SMALL + 'name = "vis"\n')
    assert problem.field == "cameras.vis.name" and "sensors" in problem.fix


def test_every_problem_is_listed_not_the_first(tmp_path):
    text = SMALL.replace("{target}", "{traget}")
    text += 'bits = "twelve"\nblak = 3\n[targets]\nwhite = { names = "w", reflectance = 98 }\ndrak = "d"\n'
    text += '[cameras.nir]\nkind = "bandz"\nfiles = "x"\n[setups.soft.cameras.viz]\nfiles = "x"\n'
    fields = [p.field for p in problems_of(tmp_path, text)]
    assert sorted(fields) == [
        "cameras.nir.kind",
        "cameras.vis.bits",
        "cameras.vis.blak",
        "cameras.vis.files",
        "setups.soft.cameras.viz",
        "targets.drak",
        "targets.white.reflectance",
    ]


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ('camera = "vis"', 'camera = "nir"', "campaign.reference.camera"),
        ("{target}/", "", "cameras.vis.files"),
        ("nm.tif", "nm{shoot}.tif", "cameras.vis.files"),
        ('"bands"', '"cube"', "cameras.vis.files"),
        ('"bands"', '"sensors"', "cameras.vis.sensors"),
        ('"bands"', '"bands"\nwavelengths = { start = 400, stop = 720, step = 30 }', "cameras.vis.wavelengths"),
        ('"bands"', '"bands"\nwavelengths = [400, 400]', "cameras.vis.wavelengths"),
        ('"bands"', '"bands"\nwavelengths = [400]\nbands = ["a", "b"]', "cameras.vis.wavelengths"),
        ('"bands"', '"bands"\nbands = ["a", "a"]', "cameras.vis.bands"),
        ('"bands"', '"bands"\npattern = "RGGX"', "cameras.vis.pattern"),
        ('"bands"', '"bands"\npattern = [["a"], ["b", "c"]]', "cameras.vis.pattern"),
        ('"bands"', '"bands"\ndemosaic = "malvar"', "cameras.vis.demosaic"),
        ('"bands"', '"bands"\nscan = "mirror"', "cameras.vis.scan"),
        ('"bands"', '"bands"\nbits = 12.5', "cameras.vis.bits"),
        ('"bands"', '"bands"\nbits = true', "cameras.vis.bits"),
        ('"bands"', '"bands"\nblack = nan', "cameras.vis.black"),
        ('"bands"', '"bands"\nblack = 5000\nsaturation = 4095', "cameras.vis.black"),
        ('"bands"', '"bands"\nexposures = "longest"', "cameras.vis.exposures"),
        ('"bands"', '"bands"\nsensitivity = "none.csv"', "cameras.vis.sensitivity"),
        ('"bands"', '"bands"\nregistration = { order = 2 }', "cameras.vis.registration.order"),
        ("[campaign]", '[campaign]\ndate = "last May"', "campaign.date"),
        ("[campaign]", "[campaign]\ntitle = 3", "campaign.title"),
        ("[campaign]", '[campaign]\ntitle = "a\\u0001b"', "campaign.title"),
        ("[campaign]", '[campaign]\noutput = "a\\u0000b"', "campaign.output"),
        ("[campaign]", '[objects.one]\ntitle = "a\\u0001b"\n[campaign]', "objects.one.title"),
        ("[campaign]", '[targets]\nobjects = ["a\\u0000b"]\n[campaign]', "targets.objects"),
        ("[campaign]", "[grid]\nregion = [0, 0, 0, 5]\n[campaign]", "grid.region"),
        ("[campaign]", "[grid]\nsize = [100]\n[campaign]", "grid.size"),
        ("[campaign]", "[grid]\nsize = [10.5, 3]\n[campaign]", "grid.size"),
        ("[campaign]", "[registration]\nratio = 0.8\n[campaign]", "registration.ratio"),
        ("[campaign]", "[registration]\nreject = 1\nstop = 2\n[campaign]", "registration.reject"),
        ("[campaign]", "[objects.a]\nsize_mm = [-1, 2]\n[campaign]", "objects.a.size_mm"),
        ("[campaign]", '[objects."a/b"]\n[campaign]', "objects.a/b"),
        ("[campaign]", '[targets]\ndark = "x"\nwhite = "x"\n[campaign]', "targets.white"),
        ("[campaign]", '[targets]\nwhite = { names = "w", reflectance = 98 }\n[campaign]', "targets.white.reflectance"),
        ("[campaign]", '[targets]\nwhite = { names = "w", reflectance = "w.csv" }\n[campaign]', "targets.white.reflectance"),
        ("[campaign]", '[setups.soft.cameras.viz]\nfiles = "{target}"\n[campaign]', "setups.soft.cameras.viz"),
        ("[campaign]", "[setups.soft.cameras.vis]\n[campaign]", "setups.soft.cameras.vis.files"),
        ("[cameras.vis]", '[cameras.grid]\nkind = "image"\nfiles = "{target}"\n[cameras.vis]', "cameras.grid"),
        ("[cameras.vis]", '[cameras."v@s"]\nkind = "image"\nfiles = "{target}"\n[cameras.vis]', "cameras.v@s"),
        ("[cameras.vis]", '[cameras.VIS]\nkind = "image"\nfiles = "{target}"\n[cameras.vis]', "cameras.vis"),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused_by_field(tmp_path, old, new, field):
    problems = problems_of(tmp_path, SMALL.replace(old, new, 1))
    assert field in {p.field for p in problems}
    assert {p.file for p in problems} == {str(tmp_path.resolve() / "campaign.toml")}


def test_a_layer_has_one_file_name(tmp_path):
    text = SMALL + '[cameras.vis_soft]\nkind = "image"\nfiles = "{target}"\n'
    text += '[setups.soft.cameras.vis]\nfiles = "soft/{target}/{wavelength}.tif"\n'
    (problem,) = problems_of(tmp_path, text)
    assert problem.field == "setups.soft.cameras.vis" and "cameras.vis_soft" in problem.expected


SENSORS = """
[campaign]
reference = { camera = "m" }
[cameras.m]
kind = "sensors"
files = "raw/{target}/{sensor}_{shot}.tif"
[[cameras.m.sensors]]
name = "ccd1"
pattern = "RGGB"
bands = ["R1", "G1", "B1"]
[[cameras.m.sensors]]
name = "ccd2"
"""


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("{sensor}_", "", "cameras.m.sensors.ccd1.files"),
        ('name = "ccd2"', 'name = "ccd1"', "cameras.m.sensors.ccd1"),
        ('"R1", "G1", "B1"', '"R1", "G1"', "cameras.m.sensors.ccd1.bands"),
        ('name = "ccd2"', 'name = "ccd2"\nalign = [[1, 0, 2]]', "cameras.m.sensors.ccd2.align"),
        ('name = "ccd2"', 'name = "ccd2"\nalign = [[1, 1, 0], [1, 1, 0]]', "cameras.m.sensors.ccd2.align"),
        ('name = "ccd2"', 'name = "ccd2"\nalgin = "measure"', "cameras.m.sensors.ccd2.algin"),
        ('kind = "sensors"', 'kind = "sensors"\npattern = "RGGB"', "cameras.m.pattern"),
        ('kind = "sensors"', 'kind = "sensors"\nbands = ["a"]', "cameras.m.bands"),
    ],
)  # fmt: skip
def test_a_sensor_is_named_where_something_is_wrong_with_it(tmp_path, old, new, field):
    load_campaign(written(tmp_path, SENSORS))
    assert field in {p.field for p in problems_of(tmp_path, SENSORS.replace(old, new, 1))}


def test_keys_of_a_camera_stand_over_those_of_the_campaign(tmp_path):
    text = (
        SMALL + "[cameras.vis.registration]\nstop = 0.5\n[registration]\nstop = 1.0\nreject = 80\n"
    )
    campaign = load_campaign(written(tmp_path, text))
    assert campaign.registration_of("vis") == {"stop": 0.5, "reject": 80.0}


def test_keys_of_the_papers_method_reach_only_cameras_that_use_it(tmp_path):
    text = (
        SMALL
        + '[cameras.nir]\nkind = "image"\nfiles = "{target}.tif"\nregistration = { method = "levkas" }\n'
    )
    text += '[registration]\nmethod = "mirhashemi2019"\norder = 2\n'
    campaign = load_campaign(written(tmp_path, text))
    assert campaign.registration_of("vis") == {"method": "mirhashemi2019", "order": 2}
    assert campaign.registration_of("nir") == {"method": "levkas"}


def test_options_name_what_the_registration_has():
    from levkas.registration.features import DETECTORS
    from levkas.registration.matching import MATCHERS
    from levkas.registration.methods import METHODS
    from levkas.registration.run import BUILT_IN

    assert set(BUILT_IN) <= set(METHODS)
    options = METHODS["mirhashemi2019"].options.model_fields
    for key, rows in (("detector", DETECTORS), ("matching", MATCHERS)):
        assert set(get_args(get_args(options[key].annotation)[0])) == set(rows)


WHOLE = tomllib.loads(
    SENSORS
    + """
    [cameras.vis]
    kind = "bands"
    files = ["raw/{target}/{wavelength}nm.tif"]
    wavelengths = { start = 400, stop = 720, step = 10 }
    registration = { stop = 0.5 }
    [grid]
    region = [0, 0, 5, 5]
    [targets]
    dark = "dark"
    white = { names = "white", reflectance = 0.98 }
    charts = { macbeth = "ColorChecker24" }
    objects = ["a"]
    [setups.soft.cameras.vis]
    files = "{target}/{wavelength}"
    [objects.a]
    size_mm = [3, 4]
    date = 1650
    [registration]
    reject = 80
    """
)
VALUES = [
    None,
    True,
    -1,
    0,
    3,
    1e300,
    float("nan"),
    "",
    "x",
    "{target}",
    [],
    ["x"],
    [1, 2],
    [[]],
    {},
    {"x": {}},
]


def test_the_whole_campaign_of_the_next_test_is_sound():
    assert _validate(Path("/none/campaign.toml"), WHOLE)[1] == []


def places(table, *above):
    for key, value in table.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from places(value, *above, key)


@given(
    st.lists(st.tuples(st.sampled_from(sorted(places(WHOLE))), st.sampled_from(VALUES)), max_size=3)
)
def test_whatever_stands_in_its_place_a_value_is_read_or_refused_with_its_field(changes):
    record = copy.deepcopy(WHOLE)
    for place, value in changes:
        table = record
        for step in place[:-1]:
            table = table.get(step) if isinstance(table, dict) else None
        if isinstance(table, dict):
            table.pop(place[-1], None)
            if value is not None:
                table[place[-1]] = value
    _, problems = _validate(Path("/none/campaign.toml"), record)
    assert all(p.field and p.file and p.message for p in problems)


EVERY = tomllib.loads(
    SENSORS
    + """
    [cameras.vis]
    kind = "bands"
    files = "raw/{target}/{wavelength}nm.tif"
    wavelengths = { start = 400, stop = 720, step = 10 }
    [cameras.charted]
    kind = "bands"
    files = "raw/{target}/{wavelength}nm.tif"
    white = { chart = "macbeth" }
    """
)
PLACES = {"cameras.NAME.white": ("cameras", "charted", "white")}


def table_at(record, table):
    """Return a table of a document by its place with NAME, made where it is not there; a list's first."""
    steps = PLACES.get(table, table.replace("NAME", "vis").split("."))
    if table == "cameras.NAME.sensors":
        return record["cameras"]["m"]["sensors"][0]
    for step in steps[:-1] if steps[-1] == "creators" else steps:
        record = record.setdefault(step, {})
    return record.setdefault("creators", [{}])[0] if steps[-1] == "creators" else record


@pytest.mark.parametrize(
    "date", ["2024-13-45", "2023-02-29", "2024-00", "0000", "2024-05-31T25:00"]
)
@pytest.mark.parametrize("table", [t for t, keys in TABLES.items() if "date" in keys])
def test_a_date_that_no_calendar_has_is_refused(table, date):
    record = copy.deepcopy(EVERY)
    table_at(record, table)["date"] = date
    _, problems = _validate(Path("/none/campaign.toml"), record)
    free = table == "objects.NAME" and not re.fullmatch(r"\d{4}-\d\d-\d\d", date)
    assert bool([p for p in problems if p.field and p.field.endswith("date")]) != free


OF_PATHS = {
    "output": "campaign", "points": "registration", "reference": "cameras.NAME.white",
    "files": "cameras.NAME", "sensitivity": "cameras.NAME", "manifest": "cameras.NAME",
    "reflectance": "targets.white", "spectrum": "setups.NAME",
}  # fmt: skip


@pytest.mark.parametrize("key", OF_PATHS)
@pytest.mark.parametrize("text", ["~/x", "~", "~anna/x/{target}.tif"])
def test_a_home_in_the_shells_way_is_refused_in_every_path(key, text):
    record = copy.deepcopy(EVERY)
    table_at(record, OF_PATHS[key])[key] = text
    _, problems = _validate(Path("/none/campaign.toml"), record)
    assert [p for p in problems if p.field.endswith(key)], problems


@pytest.mark.parametrize(  # object and lamps are the planner's
    "key", [key for key in GONE if not key.startswith(("object.", "setups.", "lamps.", "target."))]
)
def test_a_key_that_is_gone_is_refused_with_what_to_write(key):
    record = copy.deepcopy(EVERY)
    *tables, last = key.replace("*", next(iter(EVERY["cameras"]))).split(".")
    place = record
    for table in tables:
        place = place.setdefault(table, {})
    place[last] = True
    _, problems = _validate(Path("/none/campaign.toml"), record)
    (found,) = [p for p in problems if p.field.endswith(last)]
    assert found.code == "E_KEY" and found.fix == GONE[key]


def test_every_key_is_documented_in_the_section_of_its_table():
    sections = re.split(r"^#+ (?=`\[)", DOCS.read_text(encoding="utf-8"), flags=re.MULTILINE)
    for table, keys in TABLES.items():
        title = {
            "cameras.NAME.sensors": "`[[cameras.NAME.sensors]]`",
            "cameras.NAME.registration": "`[registration]`",
            "cameras.NAME.wavelengths": "`[cameras.NAME]`",
            "cameras.NAME.uncertainty": "`[cameras.NAME]`",
            "campaign.reference": "`[campaign]`",
            "publication.creators": "`[[publication.creators]]`",
            "targets.white": "`[targets]`",
            "setups.NAME.cameras.NAME": "`[setups.NAME.cameras.CAM]`",
            "setups.NAME": "`[setups.NAME.cameras.CAM]`",
        }.get(table, f"`[{table}]`")
        (section,) = (s for s in sections if s.startswith(title))
        assert set(keys) <= set(re.findall(r"`([a-z_]+)`", section)), table


def test_the_examples_read():
    folders = sorted(path.parent for path in EXAMPLES.glob("*/campaign.toml"))
    assert len(folders) >= 5
    for folder in folders:
        assert load_campaign(folder).cameras
