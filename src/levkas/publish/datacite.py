"""datacite.json: what a DOI is registered with (DataCite's metadata schema 4.5), and what it still lacks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.publish.describing import describe_dataset
from levkas.publish.facts import DOI, ORCID, Facts, Person, fact_missing, missing_facts

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

NAME = "datacite.json"
SCHEMA = "http://datacite.org/schema/kernel-4"
SPDX = "https://spdx.org/licenses/"


def write_datacite(publication: Publication) -> Iterator[str]:
    """Write datacite.json; what is not known is left out."""
    yield NAME
    record = describe_datacite(publication.facts, describe_dataset(publication))
    publication.write_text(NAME, to_json(record))


def describe_datacite(facts: Facts, description: str) -> dict[str, Any]:
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


def check_datacite(facts: Facts) -> tuple[list[Problem], list[Problem]]:
    """Return what DataCite requires and is missing, and what it recommends and is missing."""
    required = {
        "publication.doi": (
            facts.doi,
            "there is no DOI yet: a repository reserves one before it publishes",
            '"10.5281/zenodo.1234567"',
        ),
        "publication.publisher": (facts.publisher, "nobody is named as publisher", '"Zenodo"'),
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
        "publication.contact": (facts.contact, "nobody is named to ask", '"a.b@example.org"'),
        "publication.related": (
            facts.related,
            "no article is named that the database goes with",
            '["https://doi.org/10.1000/182"]',
        ),
    }
    if facts.licence and not facts.licence.url:
        recommended["campaign.licence"] = (
            "",
            "the licence is no known identifier and no address: no program can tell what it allows",
            '"CC-BY-4.0"',
        )
    return (
        [*missing_facts(facts), *_missing(facts, required)],
        [*_missing(facts, recommended)],
    )


def _missing(facts: Facts, told: dict[str, tuple[Any, str, str]]) -> Iterator[Problem]:
    for field, (value, message, example) in told.items():
        if not value:
            yield fact_missing(facts, field, message, example)


def _creator(person: Person) -> dict[str, Any]:
    record: dict[str, Any] = {
        "name": person.inverted,
        "nameType": "Organizational" if person.organisation else "Personal",
    }
    given, family = person.parts
    if not person.organisation and given:
        record |= {"givenName": given, "familyName": family}
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
    told = {"rights": name, "rightsUri": url}
    if spdx:
        told |= {"rightsIdentifier": spdx, "rightsIdentifierScheme": "SPDX", "schemeUri": SPDX}
    return {key: value for key, value in told.items() if value}


def _related(address: str) -> dict[str, str]:
    doi = address.startswith(DOI)
    return {
        "relatedIdentifier": address.removeprefix(DOI),
        "relatedIdentifierType": "DOI" if doi else "URL",
        "relationType": "IsDocumentedBy",
    }
