import json

import pytest
import yaml
from datacite import schema45
from hypothesis import given
from hypothesis import strategies as st

from levkas.core.problems import Refused
from levkas.database.splits import SHARES, split_objects
from levkas.publish.citation import check_datacite, cite, describe_datacite, format_cff
from levkas.publish.metadata import Person, PublicationFacts, facts_of
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


def test_datacite_gets_what_it_requires():
    record = describe_datacite(WHOLE, "about")
    required = {"creators", "titles", "publisher", "publicationYear", "types", "schemaVersion"}
    assert required <= set(record)
    assert record["publicationYear"] == "2019"
    person, museum = record["creators"]
    assert person["nameIdentifiers"][0]["nameIdentifier"].endswith("0000-0002-1825-0097")
    assert (person["familyName"], museum["nameType"]) == ("Painter", "Organizational")


def test_a_record_fits_the_published_schema_of_datacite():
    record = describe_datacite(WHOLE, "about")
    assert list(schema45.validator.iter_errors(record)) == []
    assert list(schema45.validator.iter_errors({**record, "publicationYear": 2019})) != []


def test_everything_missing_is_named_with_file_field_and_fix(database):
    report = check(database)
    assert report.ok and "A DOI needs 2 more" in report.text  # as `publish` has it
    assert [p.field for p in report.deposit] == ["publication.doi", "publication.publisher"]
    assert {p.field for p in report.advice} >= {"publication.keywords", "publication.creators"}
    assert all(
        p.file.endswith("database.toml") and "[publication]" in p.fix
        for p in (*report.deposit, *report.advice)
    )


def test_nothing_is_missing_where_all_is_said():
    record = {
        "title": "Icons",
        "date": "2019",
        "licence": "CC0-1.0",
        "publication": {
            "creators": [{"name": "A, B", "orcid": "0000-0002-1825-0097"}],
            "doi": "10.5281/zenodo.1",
            "publisher": "Zenodo",
            "description": "x",
            "keywords": ["y"],
            "version": "1",
            "contact": "z",
            "related": ["https://doi.org/10.1000/182"],
        },
    }
    assert check_datacite(facts_of(record, file="campaign.toml", objects={})) == ([], [])


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
    counts = [list(all_of_them.values()).count(split) for split in SHARES]
    assert sum(counts) == 60 and min(counts) >= 4


@given(st.sets(st.text(min_size=1, max_size=6), min_size=3, max_size=12))
def test_from_three_objects_on_no_split_is_empty(names):
    splits = split_objects(names)
    assert set(splits.values()) == set(SHARES)
    assert split_objects(reversed(sorted(names))) == splits


@pytest.mark.parametrize(
    ("record", "organisation"),
    [
        ("bell hooks", False),
        ("danah boyd", False),
        ("The Museum", True),
        ({"name": "The Museum", "organisation": False}, False),
        ({"name": "bell hooks", "organisation": True}, True),
        ("levkas simulate", True),
    ],
)
def test_a_person_in_small_letters_is_one_and_what_is_declared_counts(record, organisation):
    facts = facts_of({"publication": {"creators": [record]}}, file="x", objects={})
    assert facts.creators[0].organisation is organisation


@pytest.mark.parametrize(
    "record",
    [{"creator": 5}, {"publication": "x"}, {"publication": {"creators": [5]}}, {"publication": {"keywords": 5}},
     {"reference": []}, {"cameras": 5}, {"publication": {"creators": [[1]]}}],
)  # fmt: skip
def test_facts_of_another_kind_are_refused(record):
    with pytest.raises(Refused, match="another kind"):
        facts_of(record, file="database.toml", objects={})
