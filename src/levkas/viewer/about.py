"""What every page says of the database as a whole: title, makers, licence, how to cite it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


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

    def to_dict(self) -> dict[str, Any]:
        """Return what a page needs."""
        return asdict(self)


def about_of(facts: Any) -> About:
    """Return what pages say, from the facts of a publication (`levkas.publish.facts.Facts`)."""
    licence = facts.licence
    return About(
        title=facts.title or "Spectral image database",
        creator="; ".join(person.name for person in facts.creators),
        licence=licence.name if licence else "",
        licence_url=_address(licence.url) if licence else "",
        citation=cite(facts),
        description=facts.description,
        version=facts.version,
    )


def cite(facts: Any) -> str:
    """Say how to cite a database: makers (year). Title. Version. Publisher. DOI or address."""
    makers = "; ".join(person.inverted for person in facts.creators)
    year = facts.published[:4]
    parts = [
        f"{makers} ({year})" if makers and year else makers or year,
        facts.title,
        f"Version {facts.version}" if facts.version else "",
        facts.publisher,
        f"https://doi.org/{facts.doi}" if facts.doi else facts.url,
    ]
    return ". ".join(part.rstrip(".") for part in parts if part) + "."


def _address(text: str) -> str:
    return text if text.startswith(("https://", "http://")) else ""
