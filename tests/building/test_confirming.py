"""A person's word on a doubtful layer: accepted without a pixel made anew, lapsed with the map, and never of a refused one."""

import csv
import json
import shutil

import pytest

from levkas.building import build, status, summarise
from levkas.building.layer_verdicts import layer_verdicts, standing_lines
from levkas.campaign.edits import (
    EditsInvalid,
    FrameEdits,
    change_confirmation,
    change_edits,
    read_edits,
)
from levkas.campaign.schema.tables import ConfirmKeys
from levkas.core.digests import hash_tree
from levkas.database.registrations import digest_of_map
from levkas.workbench.library import Library
from levkas.workbench.session import OperationRefused

WORD = ("Doe, Jane", "2026-10-03", "the contours agree in the flicker")


@pytest.fixture
def campaign(doubtful, tmp_path):
    return shutil.copytree(doubtful, tmp_path / "campaign")


def record_of(folder, camera="infrared"):
    return json.loads((folder / f"database/objects/one/registration/{camera}.json").read_text())


def said(name, date, words, digest, camera):
    return ConfirmKeys(camera=camera, name=name, date=date, words=words, map=digest)


def confirm(folder, camera="infrared", word=WORD):
    word = word and said(*word, digest_of_map(record_of(folder, camera)), f"one/{camera}")
    change_confirmation(folder / "edits.toml", "one", camera, word)


def built(folder):
    report = summarise(list(build(folder)))
    return report, {(s.key.layer, s.key.stage) for s in report.stages if s.state == "done"}


def verdict_in_catalogue(folder):
    with (folder / "database/catalogue.csv").open() as file:
        return {row["camera"]: row["verdict"] for row in csv.DictReader(file)}["infrared"]


@pytest.mark.slow
def test_a_doubtful_layer_is_accepted_in_a_persons_name_and_no_pixel_is_made_anew(campaign):
    before, own = hash_tree(campaign / "database"), record_of(campaign)["verdict"]
    assert own["decision"] == "warn" and verdict_in_catalogue(campaign) == "warn"
    confirm(campaign)
    stale = {s.key.stage for s in status(campaign).stages if s.state == "stale"}
    assert stale == {"report", "catalogue"}
    report, done = built(campaign)
    assert done == {("", "report"), ("", "catalogue")}
    verdict = record_of(campaign)["verdict"]
    assert verdict["decision"] == "confirmed" and not verdict["confirmed"]["lapsed"]
    assert [verdict["confirmed"][key] for key in ("name", "date", "words")] == list(WORD)
    assert verdict["confirmed"]["program"] == {k: own[k] for k in verdict["confirmed"]["program"]}
    assert all(reason in " ".join(verdict["reasons"]) for reason in (*own["reasons"], WORD[2]))
    assert verdict_in_catalogue(campaign) == f"accepted by {WORD[0]}, {WORD[1]}"
    (row,) = (one for one in layer_verdicts(report) if one["camera"] == "infrared")
    assert row["verdict"] == "confirmed" and row["confirmed"]["name"] == WORD[0]
    (line,) = (one for one in standing_lines(status(campaign)) if "infrared" in one)
    assert WORD[0] in line and own["reasons"][0] in line
    page = (campaign / "database/objects/one/report.html").read_text()
    assert WORD[0] in page and WORD[2] in page
    assert built(campaign)[1] == set()

    confirm(campaign, word=None)
    built(campaign)
    assert hash_tree(campaign / "database") == before


@pytest.mark.slow
def test_the_word_lapses_with_the_map_and_a_layer_that_is_registered_anew_keeps_it_without(
    campaign,
):
    confirm(campaign)
    path = campaign / "database/objects/one/registration/infrared.json"
    path.unlink()
    assert ("infrared", "register") in built(campaign)[1]
    assert record_of(campaign)["verdict"]["decision"] == "confirmed"
    looked_at = record_of(campaign)["verdict"]["confirmed"]["map"]

    pairs = tuple(
        (x, y, x + 8.0, y + 4.0) for x, y in ((220.0, 40.0), (270.0, 120.0), (230.0, 200.0))
    )
    nothing, given = FrameEdits(), FrameEdits(added=pairs)
    change_edits(campaign / "edits.toml", "one", lambda _: "infrared", nothing, given)
    assert ("infrared", "resample") in built(campaign)[1]
    record = record_of(campaign)
    assert digest_of_map(record) != looked_at
    assert record["verdict"]["decision"] == "warn" == verdict_in_catalogue(campaign)
    assert record["verdict"]["confirmed"]["lapsed"]
    assert WORD[0] in record["verdict"]["reasons"][0]


def test_a_refused_layer_is_never_confirmed(campaign):
    assert record_of(campaign, "xray")["verdict"]["decision"] == "refuse"
    confirm(campaign, "xray")
    built(campaign)
    assert record_of(campaign, "xray")["verdict"]["decision"] == "refuse"
    library = Library(campaign)
    frames = {row["camera"]: library.open(row["id"]) for row in library.list()}
    for camera, map_ in (
        ("xray", digest_of_map(record_of(campaign, "xray"))),
        ("photo", digest_of_map(record_of(campaign, "photo"))),
        ("infrared", "of another map"),
    ):
        with pytest.raises(OperationRefused):
            library.confirm(frames[camera], WORD[0], WORD[2], map_)
    with pytest.raises(EditsInvalid):
        library.confirm(frames["infrared"], "", WORD[2], digest_of_map(record_of(campaign)))
    confirmed = read_edits(campaign / "edits.toml").confirmed
    assert set(confirmed) == {("one", "xray")}


def test_a_confirmation_of_what_is_not_there_or_twice_is_refused_and_all_corrections_stay(
    campaign,
):
    path = campaign / "edits.toml"
    text = "# Mine.\nversion = 1\n\n[objects.one.cameras.infrared]\nstop = 2.5  # by eye\n"
    path.write_text(text)
    confirm(campaign)
    change_confirmation(path, "one", "radar", said(*WORD, "1", "one/radar"))
    assert read_edits(path).frames[("one", "infrared")].stop == 2.5
    assert len(read_edits(path).confirmed) == 2
    with pytest.raises(EditsInvalid) as refused:
        list(build(campaign))
    assert refused.value.problems[0].found == "one/radar"
    change_confirmation(path, "one", "radar", None)
    twice = path.read_text()
    confirm(campaign, word=None)
    assert not read_edits(path).confirmed
    assert read_edits(path).frames[("one", "infrared")].stop == 2.5
    path.write_text(twice + twice[twice.index("[[confirm]]") :])
    with pytest.raises(EditsInvalid) as refused:
        read_edits(path)
    assert refused.value.problems[0].field == "confirm"
