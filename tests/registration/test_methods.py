"""A method of another package: found by its entry point, checked by its options, run like all others."""

import subprocess
import sys

import pytest

from levkas.campaign.campaign import CampaignInvalid, load_campaign

METADATA = "Metadata-Version: 2.1\nName: fancy\nVersion: 1.0\n"
MODULE = """
import numpy as np
from pydantic import BaseModel

from levkas.campaign.methods import Method
from levkas.geometry.transforms import Affine
from levkas.registration.record import Matches, Registration, Verdict


class Options(BaseModel):
    shift: float | None = None


def register(request, options):
    moved = Affine(np.array([[1.0, 0.0, options.shift or 0.0], [0.0, 1.0, 0.0]]))
    maps = {band.label: moved for band in request.target}
    return Registration("fancy", maps, Verdict("accept"), {}, Matches.none())


METHOD = Method(Options, register, per_sensor=False)
"""
SCRIPT = """
import sys
from pathlib import Path

import numpy as np

from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.registration import BandImage, RegistrationRefused, register

toml, image = Path(sys.argv[1]), BandImage.of("a", np.ones((20, 20)))
print(load_campaign(toml).registration_of("vis"))
found = register([image], [image], reference_band="a", method="fancy", shift=2.5)
print(found.transforms["a"](np.zeros((1, 2))).tolist())
toml.write_text(toml.read_text().replace('"fancy"', '"levkas"'))
try:
    load_campaign(toml)
except CampaignInvalid as refused:
    print(refused.problems[0].message, "|", refused.problems[0].fix)
try:
    register([image], [image], reference_band="a", method="fancy", shift="far")
except RegistrationRefused as refused:
    print(refused.problems[0].code, refused.problems[0].field)
"""
CAMPAIGN = """
campaign.reference = { camera = "vis" }
[cameras.vis]
kind = "image"
files = "{target}.tif"
[registration]
method = "fancy"
shift = 2.5
"""

BROKEN = """
import sys
from pathlib import Path

from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.registration import BandImage, RegistrationRefused, register

toml = Path(sys.argv[1])
try:
    load_campaign(toml)
except CampaignInvalid as refused:
    print(refused.problems[0].field, "|", refused.problems[0].message)
try:
    register([], [], reference_band="a", method="fancy")
except RegistrationRefused as refused:
    print(refused.problems[0].message)
toml.write_text(toml.read_text().partition("[registration]")[0])
print(load_campaign(toml).registration_of("vis"))
"""


def run_with(tmp_path, module, script):
    """Run a script beside an installed package whose method `fancy` is in `module`."""
    info = tmp_path / "site" / "fancy-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(METADATA)
    (info / "entry_points.txt").write_text("[levkas.registration]\nfancy = fancy_method:METHOD\n")
    (tmp_path / "site" / "fancy_method.py").write_text(module)
    toml = tmp_path / "campaign.toml"
    toml.write_text(CAMPAIGN)
    script = f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r})\n{script}"
    return subprocess.run(
        [sys.executable, "-c", script, str(toml)], capture_output=True, text=True, check=False
    )


LACKING = """
import sys

import numpy as np

from levkas.campaign.methods import code_of
from levkas.registration import BandImage, RegistrationRefused, register

image, other = (BandImage.of(name, np.ones((20, 20))) for name in "ab")
try:
    register([image, other], [image, other], reference_band="a", method="fancy")
except RegistrationRefused as refused:
    print(refused.problems[0])
print(len(code_of("fancy")), code_of("levkas"))
"""


def test_a_method_that_returns_no_map_of_a_band_is_named(tmp_path):
    done = run_with(tmp_path, MODULE.replace("request.target}", "request.target[:1]}"), LACKING)
    refused, codes = done.stdout.splitlines()
    assert refused.startswith("the registration method 'fancy' returns no map for 1 of 2 bands")
    assert "found: b" in refused and codes == "16 ", done.stderr


def test_a_method_that_is_not_installed_is_refused_with_what_to_install(tmp_path):
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.replace("shift = 2.5", ""))
    with pytest.raises(CampaignInvalid, match="that of a package which is installed beside Levkas"):
        load_campaign(tmp_path / "campaign.toml")


def test_an_installed_package_adds_a_method(tmp_path):
    done = run_with(tmp_path, MODULE, SCRIPT)
    assert done.stdout.splitlines() == [
        "{'method': 'fancy', 'shift': 2.5}",
        "[[2.5, 0.0]]",
        "the method 'levkas' has no `shift` | Remove it, or write method = \"fancy\".",
        "E_VALUE registration.shift",
    ], done.stderr


@pytest.mark.parametrize(
    ("module", "why"),
    [
        (
            "import nowhere_to_be_found",
            "raises ModuleNotFoundError: No module named 'nowhere_to_be_found'",
        ),
        ("METHOD = print", "is not a Method with a function"),
    ],
)
def test_a_method_that_cannot_be_loaded_is_named_and_stops_only_who_chooses_it(
    tmp_path, module, why
):
    done = run_with(tmp_path, module, BROKEN)
    why = f"fancy_method:METHOD {why}"
    assert done.stdout.splitlines() == [
        f"registration.method | method must be another one: 'fancy' cannot be used, {why}",
        f"unknown registration method 'fancy': {why}",
        "{}",
    ], done.stderr
    assert done.stderr.count(f"the registration method 'fancy' cannot be used: {why}") == 1
