"""`reject` and `stop` of the paper's method, where another method registers."""

import pytest

from levkas.building import build, status, summarise
from levkas.campaign.campaign import load_campaign

NO_EFFECT = 'has no effect with the default method; it is an option of method = "mirhashemi2019"'


def added(folder, text):
    with (folder / "campaign.toml").open("a") as file:
        file.write(text)


def test_a_build_and_status_say_once_that_a_threshold_has_no_effect(make_plates, tmp_path):
    folder = make_plates(tmp_path, ["one"])
    plain = status(folder).warnings
    added(folder, "[registration]\nstop = 0.8\nreject = 90\n")
    wanted = tuple(f"campaign.toml: registration.{key} {NO_EFFECT}" for key in ("reject", "stop"))
    assert status(folder).warnings == (*wanted, *plain)
    report = summarise(build(folder))
    assert report.ok and all(report.warnings.count(text) == 1 for text in wanted)
    assert all(report.text.count(text) == 1 for text in wanted)


def test_it_is_said_of_the_camera_that_has_the_key_and_of_corrections(make_plates, tmp_path):
    folder = make_plates(tmp_path, ["one"])
    added(folder, "[cameras.infrared.registration]\nstop = 0.8\n")
    (folder / "edits.toml").write_text(
        'version = 1\n[objects."one".cameras."infrared"]\nreject = 40.0\n'
    )
    assert load_campaign(folder).without_effect == (
        f"campaign.toml: cameras.infrared.registration.stop {NO_EFFECT}",
        f'edits.toml: objects."one".cameras."infrared".reject {NO_EFFECT}',
    )


@pytest.mark.parametrize("where", ["registration", "cameras.infrared.registration"])
def test_nothing_is_said_where_the_method_has_them(make_plates, tmp_path, where):
    folder = make_plates(tmp_path, ["one"])
    added(folder, f'[{where}]\nmethod = "mirhashemi2019"\nstop = 0.8\n')
    assert load_campaign(folder).without_effect == ()
