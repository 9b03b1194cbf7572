"""CITATION.cff of a data set (Citation File Format 1.2.0), and the citation as a line of text."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from levkas.publish.describing import describe_dataset
from levkas.publish.facts import DOI, ORCID, Facts, Person

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

NAME = "CITATION.cff"


def write_citation(publication: Publication) -> Iterator[str]:
    """Write CITATION.cff."""
    yield NAME
    publication.write_text(NAME, spell_cff(publication.facts, describe_dataset(publication)))


def spell_cff(facts: Facts, description: str) -> str:
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


def cite(facts: Facts) -> str:
    """Return the citation as text, as DataCite recommends it.

    Examples
    --------
    >>> cite(Facts("", "Icons", (Person("Ada Painter"),), published="2019-08", publisher="Zenodo"))
    'Painter, Ada (2019). Icons. Zenodo. [Data set]'
    """
    people = "; ".join(person.inverted for person in facts.creators)
    parts = [f"{people} ({facts.year})", facts.title]
    if facts.version:
        parts[-1] += f" (version {facts.version})"
    parts += [facts.publisher] if facts.publisher else []
    return ". ".join(parts) + ". [Data set]" + (f" {DOI}{facts.doi}" if facts.doi else "")


def _author(person: Person) -> dict[str, str]:
    given, family = person.parts
    told = {"name": person.name} if person.organisation or not given else {}
    if not told:
        told = {"family-names": family, "given-names": given}
    if person.affiliation and "name" not in told:
        told["affiliation"] = person.affiliation
    if person.orcid:
        told["orcid"] = ORCID + person.orcid
    return told


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
