"""Bibliographic metadata of a database: database.toml, read and completed."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levkas.campaign.schema.toml import read_toml
from levkas.core.problems import Problem, Refused

NAME = "database.toml"
DOI = "https://doi.org/"
ORCID = "https://orcid.org/"

LICENCES = {
    "CC0-1.0": ("Creative Commons Zero v1.0 Universal", "publicdomain/zero/1.0/"),
    "CC-BY-4.0": ("Creative Commons Attribution 4.0 International", "licenses/by/4.0/"),
    "CC-BY-SA-4.0": (
        "Creative Commons Attribution Share Alike 4.0 International",
        "licenses/by-sa/4.0/",
    ),
    "CC-BY-NC-4.0": (
        "Creative Commons Attribution Non Commercial 4.0 International",
        "licenses/by-nc/4.0/",
    ),
    "CC-BY-NC-SA-4.0": (
        "Creative Commons Attribution Non Commercial Share Alike 4.0 International",
        "licenses/by-nc-sa/4.0/",
    ),
    "CC-BY-ND-4.0": (
        "Creative Commons Attribution No Derivatives 4.0 International",
        "licenses/by-nd/4.0/",
    ),
    "CC-BY-NC-ND-4.0": (
        "Creative Commons Attribution Non Commercial No Derivatives 4.0 International",
        "licenses/by-nc-nd/4.0/",
    ),
}
"""Of data sets, by SPDX's identifiers: name, and path below creativecommons.org."""


@dataclass(frozen=True)
class Person:
    """A maker of the database: a person, or an organisation."""

    name: str
    orcid: str = ""
    affiliation: str = ""
    organisation: bool = False

    @property
    def parts(self) -> tuple[str, str]:
        """Given and family name; the given one is empty of a name that is not written ``Family, Given``.

        >>> Person("Mirhashemi, Alireza").parts, Person("Opificio delle Pietre Dure").parts
        (('Alireza', 'Mirhashemi'), ('', 'Opificio delle Pietre Dure'))
        """
        family, _, given = (part.strip() for part in self.name.partition(","))
        return given, family

    @property
    def inverted(self) -> str:
        """The name as lists have it: ``Family, Given``; an organisation's as it is."""
        given, family = self.parts
        return self.name if self.organisation or not given else f"{family}, {given}"


@dataclass(frozen=True)
class Licence:
    """A licence: what it is called, its address, and SPDX's identifier where it has one."""

    name: str
    url: str = ""
    spdx: str = ""


@dataclass(frozen=True)
class PublicationFacts:
    """Facts of a database as a whole; unknown ones are empty.

    `file` is where they are declared. `cameras`, `setups` and `objects` hold the tables of
    database.toml and object.toml by name.
    """

    file: str
    title: str = ""
    creators: tuple[Person, ...] = ()
    licence: Licence | None = None
    date: str = ""
    published: str = ""
    publisher: str = ""
    doi: str = ""
    version: str = ""
    url: str = ""
    description: str = ""
    keywords: tuple[str, ...] = ()
    contact: str = ""
    related: tuple[str, ...] = ()
    reference: str = ""
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    setups: dict[str, dict[str, Any]] = field(default_factory=dict)
    objects: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def year(self) -> str:
        """Year of publication."""
        return self.published[:4]


def read_facts(database: str | Path) -> PublicationFacts:
    """Read database.toml and every object.toml of a database; what is not there is empty.

    Raises
    ------
    TomlRefused
        Where a file is there and cannot be read.
    """
    root = Path(database)
    record = _toml(root / NAME)
    objects = {path.parent.name: _toml(path) for path in sorted(root.glob("objects/*/object.toml"))}
    return facts_of(record, file=str(root / NAME), objects=objects)


def facts_of(
    record: dict[str, Any], *, file: str, objects: dict[str, dict[str, Any]]
) -> PublicationFacts:
    """Return the facts of a record as database.toml has it; raises Refused where a value is of another kind."""
    try:
        return _facts_of(record, file, objects)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise Refused(
            Problem(
                "E_VALUE",
                f"{NAME} has a value of another kind than a build writes",
                file,
                found=str(error)[:200],
                fix="Correct the value, or build the database again.",
            )
        ) from error


def _facts_of(
    record: dict[str, Any], file: str, objects: dict[str, dict[str, Any]]
) -> PublicationFacts:
    publication = record.get("publication", {})
    creators = [_person(c) for c in publication.get("creators") or [record.get("creator", "")]]
    reference = record.get("reference", {})
    return PublicationFacts(
        file=file,
        title=_line(record.get("title", "")),
        creators=tuple(c for c in creators if c.name),
        licence=licence_of(record.get("licence", "")),
        date=str(record.get("date", "")),
        published=str(publication.get("date") or record.get("date") or ""),
        publisher=_line(publication.get("publisher", "")),
        doi=str(publication.get("doi", "")).removeprefix(DOI),
        version=_line(publication.get("version", "")),
        url=_line(publication.get("url", "")),
        description=_text(publication.get("description", "")),
        keywords=tuple(_line(k) for k in publication.get("keywords", ())),
        contact=_line(publication.get("contact", "")),
        related=tuple(_line(r) for r in publication.get("related", ())),
        reference=":".join(str(reference[k]) for k in ("camera", "band") if reference.get(k)),
        cameras=dict(record.get("cameras", {})),
        setups=dict(record.get("setups", {})),
        objects=objects,
    )


def licence_of(text: str) -> Licence | None:
    """Return the licence of an identifier, address or name; None for an empty one.

    Examples
    --------
    >>> licence_of("CC-BY-4.0").url
    'https://creativecommons.org/licenses/by/4.0/'
    >>> licence_of("All rights reserved")
    Licence(name='All rights reserved', url='', spdx='')
    """
    text = _line(text)
    spelled = re.sub(r"[\s_]+", "-", text.upper())
    for spdx, (name, path) in LICENCES.items():
        url = f"https://creativecommons.org/{path}"
        if spelled == spdx or text.removesuffix("/").replace("http:", "https:") == url[:-1]:
            return Licence(name, url, spdx)
    if re.match(r"https?://\S+$", text):
        return Licence(text, text)
    return Licence(text) if text else None


def missing_facts(facts: PublicationFacts) -> list[Problem]:
    """Return what must be known before anything is published: title, creator, licence and date."""
    required = {
        "campaign.title": (facts.title, "the database has no title", '"Icons of Levkas"'),
        "campaign.creator": (
            facts.creators,
            "the creator is missing",
            '"Family, Given"',
        ),
        "campaign.licence": (
            facts.licence,
            "the database has no licence, so nobody may use it",
            '"CC-BY-4.0"',
        ),
        "campaign.date": (
            facts.published,
            "neither the captures nor the campaign have a date",
            "2024-05-31",
        ),
    }
    return [
        fact_missing(facts, field, message, example)
        for field, (value, message, example) in required.items()
        if not value
    ]


def fact_missing(facts: PublicationFacts, field: str, message: str, example: str) -> Problem:
    """Return the problem of a fact that is not known."""
    table, _, key = field.partition(".")
    fix = f"Write {key} = {example} in [{table}] of campaign.toml, then run levkas build."
    return Problem("E_FACT_MISSING", message, file=facts.file, field=field, fix=fix)


def _person(record: Any) -> Person:
    if isinstance(record, str):
        record = {"name": record}
    return Person(
        _line(record.get("name", "")),
        str(record.get("orcid", "")).removeprefix(ORCID),
        _line(record.get("affiliation", "")),
        record.get("organisation") is True,
    )


def _toml(path: Path) -> dict[str, Any]:
    return read_toml(path) if path.exists() or path.is_symlink() else {}


def _line(value: Any) -> str:
    """One line of text: control characters and line ends become spaces."""
    return " ".join(re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", str(value)).split())


def _text(value: Any) -> str:
    """Text of several lines without control characters."""
    lines = re.sub(r"[\u2028\u2029\x85]|\r\n?", "\n", str(value)).split("\n")
    return "\n".join(_line(line) for line in lines).strip()
