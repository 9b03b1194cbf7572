"""What the landing page of a publication tells search engines: schema.org's Dataset, in JSON-LD. What is not known is left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from levkas.publish.citation import cite
from levkas.publish.metadata import DOI, ORCID, Person
from levkas.publish.publication import describe_dataset

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

ITEMS = (("catalogue.csv", "text/csv"), ("manifest-sha256.txt", "text/plain"))
"""Tables from which every file is found."""


def describe_landing(publication: Publication) -> dict[str, Any]:
    """Return the record of the whole publication as JSON-LD in the words of schema.org."""
    facts = publication.facts
    address = facts.url or publication.url
    record: dict[str, Any] = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "@id": DOI + facts.doi if facts.doi else address,
        "identifier": DOI + facts.doi if facts.doi else "",
        "url": address,
        "name": facts.title,
        "description": describe_dataset(publication),
        "creator": [_describe_person(person) for person in facts.creators],
        "publisher": {"@type": "Organization", "name": facts.publisher} if facts.publisher else {},
        "datePublished": facts.published,
        "temporalCoverage": facts.date,
        "version": facts.version,
        "keywords": list(facts.keywords),
        "license": (facts.licence.url or facts.licence.name) if facts.licence else "",
        "creditText": cite(facts),
        "citation": list(facts.related),
        "encodingFormat": ["image/tiff", "application/vnd+zarr", "text/csv"],
        "distribution": [
            {
                "@type": "DataDownload",
                "contentUrl": f"{address}{name}" if publication.url else name,
                "encodingFormat": kind,
            }
            for name, kind in ITEMS
        ],
    }
    return {key: value for key, value in record.items() if value}


def _describe_person(person: Person) -> dict[str, Any]:
    given, family = person.parts
    record: dict[str, Any] = {
        "@type": "Organization" if person.organisation else "Person",
        "@id": ORCID + person.orcid if person.orcid else "",
        "name": person.name,
        "givenName": "" if person.organisation else given,
        "familyName": family if given and not person.organisation else "",
        "affiliation": {"@type": "Organization", "name": person.affiliation}
        if person.affiliation
        else {},
    }
    return {key: value for key, value in record.items() if value}
