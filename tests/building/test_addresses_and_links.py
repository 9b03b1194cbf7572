"""What looks like nothing and is something: links that lead nowhere, addresses in place of folders."""

import pytest

from levkas.building import build, status, summarise
from levkas.campaign.campaign import CampaignInvalid
from levkas.campaign.edits import EditsInvalid
from levkas.core.problems import Refused


@pytest.fixture(scope="module")
def folder(make_plates, tmp_path_factory):
    return make_plates(tmp_path_factory.mktemp("links") / "campaign", ["one", "two"])


@pytest.mark.parametrize("call", [lambda *a, **k: list(build(*a, **k)), status])
def test_an_address_is_no_folder_to_build_into(folder, call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused) as refused:
        call(folder, output="s3://museum/icons")
    assert "address" in refused.value.problems[0].message
    assert refused.value.problems[0].file == "s3://museum/icons"
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("call", [lambda *a, **k: list(build(*a, **k)), status])
def test_a_home_that_no_shell_expanded_is_no_folder_to_build_into(
    folder, call, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused, match="~ means a home to shells alone"):
        call(folder, output="~/icons")
    assert not [*tmp_path.iterdir()]


def test_an_address_as_the_campaign_s_output_is_refused(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(
        text.replace("[campaign]\n", '[campaign]\noutput = "https://museum.org/icons"\n')
    )
    with pytest.raises(CampaignInvalid) as refused:
        list(build(folder))
    assert refused.value.problems[0].field == "campaign.output"


def test_corrections_behind_a_link_that_leads_nowhere_are_not_left_out(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    (folder / "edits.toml").symlink_to(tmp_path / "gone.toml")
    for call in (status, lambda path: list(build(path))):
        with pytest.raises(EditsInvalid):
            call(folder)


def test_a_frame_and_points_behind_such_a_link_are_refused_by_name(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one", "two"])
    with (folder / "campaign.toml").open("a") as file:
        file.write('[registration]\npoints = "points/{object}_{camera}.csv"\n')
    (folder / "infrared/one.png").unlink()
    (folder / "infrared/one.png").symlink_to(tmp_path / "unplugged/one.png")
    (folder / "points").mkdir()
    (folder / "points/two_infrared.csv").symlink_to(tmp_path / "unplugged/two.csv")
    report = summarise(build(folder))
    files = {problem.file for problem in report.problems}
    assert files == {str(folder / "infrared/one.png"), str(folder / "points/two_infrared.csv")}


@pytest.mark.slow
def test_a_link_in_a_circle_is_one_missing_frame(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one", "two"])
    (folder / "infrared/old").symlink_to("old")
    (folder / "infrared/one.png").unlink()
    (folder / "infrared/one.png").symlink_to("one.png")
    report = summarise(build(folder))
    assert {p.file for p in report.problems} == {str(folder / "infrared/one.png")}
    assert (folder / "database/objects/two").is_dir()


def test_a_folder_that_cannot_be_listed_refuses_its_camera_alone(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    (folder / "infrared").rename(tmp_path / "away")
    (folder / "infrared").symlink_to("infrared")
    report = summarise(build(folder))
    (problem,) = report.problems
    assert (problem.file, "link" in problem.fix) == (str(folder / "infrared"), True)
    assert list((folder / "database/objects/one").rglob("*.tif"))
