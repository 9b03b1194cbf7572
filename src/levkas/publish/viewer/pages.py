"""Pages of the viewer: the contact sheet of a database, and one page an object.

All text from outside is escaped by the templates; records for scripts are JSON in which nothing can
end the element that holds it. A policy in the page itself forbids inline scripts and other hosts.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from levkas import __version__
from levkas.pages.page import render_page
from levkas.publish.citation import cite
from levkas.publish.metadata import DOI
from levkas.registration.record import DECISIONS

if TYPE_CHECKING:
    from levkas.publish.metadata import PublicationFacts

POLICY = (
    "default-src 'none'; script-src 'self' file:; style-src 'self' file:; "
    "img-src 'self' file: data: blob:; base-uri 'none'; form-action 'none'"
)
UNSAFE = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}
ORDER = ("refuse", "by hand", "warn", "confirmed", "accept")


def render_sheet(
    about: About, objects: Sequence[dict[str, Any]], more: Sequence[dict[str, str]] = ()
) -> str:
    """Return the contact sheet's HTML; `objects` are as `card_of` has them, `more` links with label and href."""
    cameras = sorted({camera for card in objects for camera in card["cameras"]})
    there = {card["decision"] for card in objects}
    verdicts = {key: DECISIONS[key] for key in reversed(ORDER) if key in there}
    facts = {"about": about, "objects": objects, "cameras": cameras, "verdicts": verdicts}
    return _render("sheet.html", **facts, more=more)


def render_object(about: About, record: dict[str, Any]) -> str:
    """Return the HTML of an object's page from its record."""
    from markupsafe import Markup

    return _render(
        "object.html",
        about=about,
        object=record["object"],
        links=record["links"],
        downloads=[
            {**file, "size": format_bytes(file["bytes"])}
            for layer in record["layers"]
            for file in layer["downloads"]
        ]
        + [{**file, "size": format_bytes(file["bytes"])} for file in record["downloads"]],
        record=Markup(embed_json(record)),
    )


def embed_json(record: Any) -> str:
    r"""Return JSON that is safe in a script element: no ``<``, ``>``, ``&``, U+2028 or U+2029.

    >>> embed_json("</script>&")
    '"\\u003c/script\\u003e\\u0026"'
    """
    return json.dumps(record, ensure_ascii=False, allow_nan=False).translate(UNSAFE)


def address(*parts: str) -> str:
    """Return a relative address of these path parts, percent-encoded.

    >>> address("objects", "a b#c")
    'objects/a%20b%23c'
    """
    return "/".join(quote(part, safe="") if part != ".." else part for part in parts)


def worst(decisions: Sequence[str]) -> str:
    """Return the worst of some verdicts.

    >>> worst(["accept", "warn"]), worst([])
    ('warn', 'accept')
    """
    return next((decision for decision in ORDER if decision in decisions), "accept")


def format_bytes(count: int) -> str:
    """Format a size in decimal units.

    >>> format_bytes(1_234_567), format_bytes(900)
    ('1.2 MB', '900 B')
    """
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} B"


def _render(template: str, **facts: Any) -> str:
    package = "levkas.publish.viewer"
    return render_page(template, package=package, policy=POLICY, version=__version__, **facts)


@dataclass(frozen=True)
class About:
    """Facts of a database; what is not known is empty. Addresses are http or https, or empty."""

    title: str = ""
    creator: str = ""
    licence: str = ""
    licence_url: str = ""
    citation: str = ""
    description: str = ""
    version: str = ""
    doi: str = ""
    """Its address, https://doi.org/…"""


def about_of(facts: PublicationFacts) -> About:
    """Return the text of pages from the facts of a publication."""
    licence = facts.licence
    return About(
        title=facts.title or "Spectral image database",
        creator="; ".join(person.name for person in facts.creators),
        licence=licence.name if licence else "",
        licence_url=_address(licence.url) if licence else "",
        citation=cite(facts),
        description=facts.description,
        version=facts.version,
        doi=DOI + facts.doi if facts.doi else "",
    )


def _address(text: str) -> str:
    return text if text.startswith(("https://", "http://")) else ""
