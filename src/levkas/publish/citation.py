"""Citations: CITATION.cff, DataCite metadata, and one line of text."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.publish.metadata import (
    DOI,
    ORCID,
    Person,
    PublicationFacts,
    fact_missing,
)
from levkas.publish.publication import describe_dataset

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

NAME = "CITATION.cff"


def write_citation(publication: Publication) -> Iterator[str]:
    """Write CITATION.cff."""
    yield NAME
    publication.write_text(NAME, format_cff(publication.facts, describe_dataset(publication)))


def format_cff(facts: PublicationFacts, description: str) -> str:
    """Return the file's text: YAML whose values are spelled as JSON, which every YAML reader takes."""
    record: dict[str, Any] = {
        "cff-version": "1.2.0",
        "message": "If you use these data, please cite them.",
        "type": "dataset",
        "title": facts.title,
        "authors": [_author(person) for person in facts.creators],
        "abstract": description,
        "version": facts.version,
        "doi": facts.doi,
        "url": facts.url,
        "keywords": list(facts.keywords),
        # A year alone is no date in CFF.
        "date-released": facts.published[:10]
        if re.match(r"\d{4}-\d\d-\d\d", facts.published)
        else "",
    }
    if facts.licence:
        key = "license" if facts.licence.spdx else "license-url"
        record[key] = facts.licence.spdx or facts.licence.url
    return "".join(_lines({k: v for k, v in record.items() if v}))


def cite(facts: PublicationFacts) -> str:
    """Return the citation as text, as DataCite recommends it.

    Examples
    --------
    >>> cite(PublicationFacts("", "Icons", (Person("Painter, Ada"),), published="2019-08", publisher="Zenodo"))
    'Painter, Ada (2019). Icons. Zenodo. [Data set]'
    """
    people = "; ".join(person.inverted for person in facts.creators)
    parts = [f"{people} ({facts.year})", facts.title]
    if facts.version:
        parts[-1] += f" (version {facts.version})"
    parts += [facts.publisher] if facts.publisher else []
    address = DOI + facts.doi if facts.doi else facts.url
    return f"{'. '.join(parts)}. [Data set] {address}".rstrip()


def _author(person: Person) -> dict[str, str]:
    given, family = person.parts
    record = {"name": person.name} if person.organisation or not given else {}
    if not record:
        record = {"family-names": family, "given-names": given}
    if person.affiliation and "name" not in record:
        record["affiliation"] = person.affiliation
    if person.orcid:
        record["orcid"] = ORCID + person.orcid
    return record


def _lines(record: dict[str, Any]) -> Iterator[str]:
    for key, value in record.items():
        if not isinstance(value, list):
            yield f"{key}: {_spell(value)}\n"
            continue
        yield f"{key}:\n"
        for part in value:
            if isinstance(part, dict):
                inner = [f"{k}: {_spell(v)}" for k, v in part.items()]
                yield "  - " + "\n    ".join(inner) + "\n"
            else:
                yield f"  - {_spell(part)}\n"


def _spell(value: str) -> str:
    # YAML takes JSON's strings, but for DEL and C1 controls, which no reader need take raw.
    return re.sub(
        r"[\x7f-\x9f\ufeff\ufffe\uffff]",
        lambda found: f"\\u{ord(found.group()):04x}",
        json.dumps(value, ensure_ascii=False),
    )


DATACITE = "datacite.json"
SCHEMA = "http://datacite.org/schema/kernel-4"
SPDX = "https://spdx.org/licenses/"


def write_datacite(publication: Publication) -> Iterator[str]:
    """Write datacite.json; what is not known is left out."""
    yield DATACITE
    record = describe_datacite(publication.facts, describe_dataset(publication))
    publication.write_text(DATACITE, to_json(record))


def describe_datacite(facts: PublicationFacts, description: str) -> dict[str, Any]:
    """Return the record as DataCite's JSON has it."""
    licence = facts.licence
    record: dict[str, Any] = {
        "doi": facts.doi,
        "url": facts.url,
        "creators": [_creator(person) for person in facts.creators],
        "titles": [{"title": facts.title}],
        "publisher": {"name": facts.publisher} if facts.publisher else None,
        "publicationYear": facts.year,
        "types": {"resourceType": "Spectral image database", "resourceTypeGeneral": "Dataset"},
        "subjects": [{"subject": keyword} for keyword in facts.keywords],
        "dates": [{"date": facts.date, "dateType": "Collected"}] if facts.date else [],
        "language": "en",
        "formats": ["image/tiff", "application/vnd+zarr", "text/csv", "application/json"],
        "version": facts.version,
        "rightsList": [_rights(licence.name, licence.url, licence.spdx)] if licence else [],
        "descriptions": [{"description": description, "descriptionType": "Abstract"}],
        "relatedIdentifiers": [_related(address) for address in facts.related],
        "schemaVersion": SCHEMA,
    }
    return {key: value for key, value in record.items() if value}


def check_datacite(facts: PublicationFacts) -> tuple[list[Problem], list[Problem]]:
    """Return what DataCite requires beside `missing_facts` and is missing, and what it recommends and is missing."""
    required = {
        "publication.doi": (
            facts.doi,
            "there is no DOI yet: a repository reserves one before it publishes",
            '"10.5281/zenodo.1234567"',
        ),
        "publication.publisher": (facts.publisher, "the publisher is missing", '"Zenodo"'),
    }
    unnamed = [p.name for p in facts.creators if not p.orcid and not p.organisation]
    recommended = {
        "publication.creators": (
            not unnamed,
            f"creators without an ORCID: {', '.join(unnamed)}",
            '[{ name = "Family, Given", orcid = "0000-0002-1825-0097" }]',
        ),
        "publication.description": (
            facts.description,
            "there is no description; one is made from the catalogue",
            '"Six icons by five cameras …"',
        ),
        "publication.keywords": (facts.keywords, "there are no keywords", '["icons", "spectral"]'),
        "publication.version": (facts.version, "there is no version", '"1.0"'),
        "publication.contact": (
            facts.contact,
            "the contact person is missing",
            '"a.b@example.org"',
        ),
        "publication.related": (
            facts.related,
            "the related article is missing",
            '["https://doi.org/10.1000/182"]',
        ),
    }
    if facts.licence and not facts.licence.url:
        recommended["campaign.licence"] = (
            "",
            "the licence is neither an SPDX identifier nor an address: programs cannot read it",
            '"CC-BY-4.0"',
        )
    return (
        [*_missing(facts, required)],
        [*_missing(facts, recommended)],
    )


def _missing(facts: PublicationFacts, wanted: dict[str, tuple[Any, str, str]]) -> Iterator[Problem]:
    for field, (value, message, example) in wanted.items():
        if not value:
            yield fact_missing(facts, field, message, example)


def _creator(person: Person) -> dict[str, Any]:
    record: dict[str, Any] = {"name": person.inverted}
    given, family = person.parts
    if person.organisation:
        record["nameType"] = "Organizational"
    elif given:
        record |= {"nameType": "Personal", "givenName": given, "familyName": family}
    if person.orcid:
        identifier = {
            "nameIdentifier": ORCID + person.orcid,
            "nameIdentifierScheme": "ORCID",
            "schemeUri": ORCID,
        }
        record["nameIdentifiers"] = [identifier]
    if person.affiliation:
        record["affiliation"] = [{"name": person.affiliation}]
    return record


def _rights(name: str, url: str, spdx: str) -> dict[str, str]:
    record = {"rights": name, "rightsUri": url}
    if spdx:
        record |= {"rightsIdentifier": spdx, "rightsIdentifierScheme": "SPDX", "schemeUri": SPDX}
    return {key: value for key, value in record.items() if value}


def _related(address: str) -> dict[str, str]:
    doi = address.startswith(DOI)
    return {
        "relatedIdentifier": address.removeprefix(DOI),
        "relatedIdentifierType": "DOI" if doi else "URL",
        "relationType": "IsDocumentedBy",
    }
