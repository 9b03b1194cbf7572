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
@pytest.mark.parametrize("output", ["s3://museum/icons", "~/icons"])
def test_an_address_and_a_home_that_no_shell_expanded_are_no_folders_to_build_into(
    folder, call, output, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused) as refused:
        call(folder, output=output)
    assert refused.value.problems[0].file == output
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


def test_a_folder_that_cannot_be_listed_refuses_its_camera_alone(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    (folder / "infrared").rename(tmp_path / "away")
    (folder / "infrared").symlink_to("infrared")
    report = summarise(build(folder))
    (problem,) = report.problems
    assert (problem.file, "link" in problem.fix) == (str(folder / "infrared"), True)
    assert list((folder / "database/objects/one").rglob("*.tif"))
