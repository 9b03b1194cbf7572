"""A method of another package: found by its entry point, checked by its options, run like all others."""

import subprocess
import sys

import pytest

from levkas.campaign.campaign import CampaignInvalid, load_campaign

METADATA = "Metadata-Version: 2.1\nName: fancy\nVersion: 1.0\n"
MODULE = """
import numpy as np
from pydantic import BaseModel

from levkas.registration.methods import Method
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


def test_a_method_that_is_not_installed_is_refused_with_what_to_install(tmp_path):
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.replace("shift = 2.5", ""))
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(tmp_path / "campaign.toml")
    assert refused.value.problems[0].field == "registration.method"


def test_an_installed_package_adds_a_method(tmp_path):
    done = run_with(tmp_path, MODULE, SCRIPT)
    assert done.stdout.splitlines() == [
        "{'method': 'fancy', 'shift': 2.5}",
        "[[2.5, 0.0]]",
        "the method 'levkas' has no `shift` | Remove it, or write method = \"fancy\".",
        "E_VALUE registration.shift",
    ], done.stderr
