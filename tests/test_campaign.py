import re
from pathlib import Path

import pytest

from levkas.campaign import Camera, Campaign, CampaignInvalid, Document, Sensor, load_campaign

DOCS = Path(__file__).resolve().parents[1] / "docs" / "campaign.md"
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


def test_a_small_campaign_reads_with_its_defaults(tmp_path):
    campaign = load_campaign(written(tmp_path, SMALL))
    assert isinstance(campaign, Campaign)
    assert campaign.output == tmp_path.resolve() / "database"
    assert campaign.cameras["vis"].name == "vis" and campaign.cameras["vis"].exposures == "one"
    assert load_campaign(tmp_path / "campaign.toml").reference == campaign.reference


def test_a_misspelt_key_is_refused_with_the_one_that_was_meant(tmp_path):
    (problem,) = problems_of(tmp_path, SMALL.replace("files", "wavelenghts = [1]\nfiles"))
    assert problem.code == "E_KEY" and problem.field == "cameras.vis.wavelenghts"
    assert problem.fix == "Did you mean 'wavelengths'?"


def test_every_problem_is_listed_not_the_first(tmp_path):
    text = (
        SMALL
        + 'bits = "twelve"\nblak = 3\n[targets]\nwhite = { names = "w", reflectance = 0.98 }\ndrak = "d"\n'
    )
    fields = {p.field for p in problems_of(tmp_path, text)}
    assert fields == {"cameras.vis.bits", "cameras.vis.blak", "targets.drak"}


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (('camera = "vis"', 'camera = "nir"'), "campaign.reference.camera"),
        (('kind = "bands"', 'kind = "sensors"'), "cameras.vis"),
        (('files = "raw/{target}/', 'files = "raw/'), "cameras.vis.files"),
        (
            (
                'kind = "bands"',
                'kind = "bands"\nwavelengths = { start = 400, stop = 720, step = 30 }',
            ),
            "cameras.vis.wavelengths",
        ),
        (('kind = "bands"', 'kind = "bands"\npattern = "RGGX"'), "cameras.vis.pattern"),
    ],
)
def test_what_contradicts_itself_is_refused_by_field(tmp_path, change, field):
    assert field in {p.field for p in problems_of(tmp_path, SMALL.replace(*change))}


def test_a_white_of_98_is_per_cent_and_refused(tmp_path):
    text = SMALL + '[targets]\nwhite = { names = "white", reflectance = 98 }\n'
    (problem,) = problems_of(tmp_path, text)
    assert problem.field == "targets.white.reflectance"


def test_facts_of_an_object_that_is_not_declared_are_refused(tmp_path):
    text = SMALL + '[targets]\nobjects = ["icon1"]\n[objects.icno1]\ntitle = "X"\n'
    (problem,) = problems_of(tmp_path, text)
    assert problem.fix == "Did you mean 'icon1'?"


@pytest.mark.parametrize(
    "text",
    [
        "not toml [",
        "a" * 70000 + " = 1",
        ".".join("abcdefghijklmnop") + " = 1",
        "x = " + "[" * 5000,
    ],
)
def test_what_is_no_toml_or_bomb_shaped_is_refused_at_once(tmp_path, text):
    assert problems_of(tmp_path, text)[0].file.endswith("campaign.toml")


def test_a_file_larger_than_a_mebibyte_is_refused_before_it_is_read(tmp_path):
    (problem,) = problems_of(tmp_path, "# " + "x" * (1 << 20))
    assert problem.code == "E_SIZE"


def test_a_folder_without_a_campaign_says_where_the_keys_are_explained(tmp_path):
    with pytest.raises(CampaignInvalid, match=r"docs/campaign\.md"):
        load_campaign(tmp_path)


def test_keys_of_a_camera_stand_over_those_of_the_campaign(tmp_path):
    text = (
        SMALL + "[cameras.vis.registration]\nstop = 0.5\n[registration]\nstop = 1.0\nreject = 80\n"
    )
    assert load_campaign(written(tmp_path, text)).registration_of("vis") == {
        "stop": 0.5,
        "reject": 80.0,
    }


def models_in(model):
    from pydantic import BaseModel

    yield model
    for field in model.model_fields.values():
        for part in [field.annotation, *getattr(field.annotation, "__args__", ())]:
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from models_in(part)


def test_every_key_is_documented():
    text = DOCS.read_text(encoding="utf-8")
    told = set(re.findall(r"`([a-z_]+)`", text))
    keys = {name for model in (*models_in(Document), Camera, Sensor) for name in model.model_fields}
    assert keys - told == set()


@pytest.mark.parametrize(
    "name", ["two-paintings", "filterwheel-disks", "silios-kinect", "rededge", "envi-linescan"]
)
def test_the_examples_read(name):
    load_campaign(Path(__file__).resolve().parents[1] / "examples" / name)
