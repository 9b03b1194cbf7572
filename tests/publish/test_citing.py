import json
from dataclasses import replace

import pytest
import yaml
from datacite import schema45
from hypothesis import given
from hypothesis import strategies as st

from levkas.core.problems import Refused
from levkas.publish.citation import check_datacite, cite, describe_datacite, format_cff
from levkas.publish.metadata import Person, PublicationFacts, facts_of
from levkas.publish.publication import MIDDLES, split_objects
from levkas.publish.readme import plain
from levkas.publish.run import check

WHOLE = PublicationFacts(
    "campaign.toml",
    title="Icons",
    creators=(
        Person("Painter, Ada", "0000-0002-1825-0097", "A Museum"),
        Person("The Museum", organisation=True),
    ),
    published="2019-08-29",
    publisher="Zenodo",
    doi="10.5281/zenodo.1",
    version="1.0",
)


def test_the_citation_is_the_one_that_datacite_recommends():
    assert cite(WHOLE) == (
        "Painter, Ada; The Museum (2019). Icons (version 1.0). Zenodo. [Data set] "
        "https://doi.org/10.5281/zenodo.1"
    )


def test_a_record_fits_the_published_schema_of_datacite():
    record = describe_datacite(WHOLE, "about")
    assert list(schema45.validator.iter_errors(record)) == []
    assert list(schema45.validator.iter_errors({**record, "publicationYear": 2019})) != []


def test_everything_missing_is_named_with_file_field_and_fix(database):
    report = check(database)
    assert report.ok  # as `publish` has it
    assert [p.field for p in report.deposit] == ["publication.doi", "publication.publisher"]
    assert {p.field for p in report.advice} >= {"publication.keywords", "publication.creators"}
    assert all(
        p.file.endswith("database.toml") and p.fix for p in (*report.deposit, *report.advice)
    )


def test_nothing_is_missing_where_all_is_said():
    more = {"description": "x", "keywords": ("y",), "contact": "z"}
    related = ("https://doi.org/10.1000/182",)
    assert check_datacite(replace(WHOLE, **more, related=related)) == ([], [])


HOSTILE = st.text(
    st.characters(exclude_categories=("Cs",)) | st.sampled_from("\0\x07\x1b\"'\\<>&:#|`\n{}[]-"),
    min_size=1,
)


@given(HOSTILE)
def test_any_title_stays_one_string_in_the_citation_file(title):
    record = {"title": title, "creator": title, "licence": "CC0-1.0"}
    facts = facts_of(record, file="", objects={})
    reported = yaml.safe_load(format_cff(facts, "x"))
    assert reported.get("title", "") == facts.title
    assert json.loads(json.dumps(describe_datacite(facts, "x")))["titles"] == [
        {"title": facts.title}
    ]


@given(HOSTILE)
def test_markdown_gets_no_tags_and_no_marks_of_a_title(title):
    text = plain(title)
    assert "<" not in text and ">" not in text
    bare = text.replace("\\\\", "")
    assert all(bare[i - 1] == "\\" for i, c in enumerate(bare) if c in "*`[|")


def test_an_object_keeps_its_split_when_others_come():
    names = [f"icon{i}" for i in range(60)]
    some, all_of_them = split_objects(names[:40]), split_objects(names)
    assert all(all_of_them[name] == split for name, split in some.items())
    counts = [list(all_of_them.values()).count(split) for split in MIDDLES]
    assert sum(counts) == 60 and min(counts) >= 4


@given(st.sets(st.text(min_size=1, max_size=6), min_size=3, max_size=12))
def test_from_three_objects_on_no_split_is_empty(names):
    splits = split_objects(names)
    assert set(splits.values()) == set(MIDDLES)
    assert split_objects(reversed(sorted(names))) == splits


def test_names_are_turned_only_where_they_are_written_family_given():
    creators = [
        "Opificio delle Pietre Dure",
        "Trust, Anna",
        {"name": "Museum", "organisation": True},
    ]
    record = {"title": "x", "date": "2019", "publication": {"creators": creators}}
    facts = facts_of(record, file="x", objects={})
    assert [one.inverted for one in facts.creators] == [creators[0], "Trust, Anna", "Museum"]
    assert [one.organisation for one in facts.creators] == [False, False, True]
    made = describe_datacite(facts, "x")["creators"]
    assert [one.get("nameType") for one in made] == [None, "Personal", "Organizational"]


@pytest.mark.parametrize(
    "record",
    [{"creator": 5}, {"publication": "x"}, {"publication": {"creators": [5]}}, {"reference": []}],
)
def test_facts_of_another_kind_are_refused(record):
    with pytest.raises(Refused) as refused:
        facts_of(record, file="database.toml", objects={})
    assert refused.value.problems[0].code == "E_VALUE"
