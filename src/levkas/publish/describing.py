"""A database in words: the sentence that crate, DataCite and README say when nobody wrote one."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.database.catalogue import Entry
    from levkas.publish.publication import Publication


def describe_dataset(publication: Publication) -> str:
    """Return the description that was written, else one made from the catalogue."""
    return publication.facts.description or describe_catalogue(publication.entries())


def describe_catalogue(entries: Sequence[Entry]) -> str:
    """Return one sentence on objects, cameras, bands and sampling.

    Examples
    --------
    >>> from levkas.database.catalogue import Entry
    >>> row = Entry("icon1", "vis", "", 33, 640, 480, 2.0, "reflectance", "accept", "")
    >>> describe_catalogue([row])
    'Spectral images of 1 object by 1 camera with 33 bands, registered pixel by pixel; 2 px per mm.'
    """
    objects = {e.object for e in entries}
    cameras = {e.camera: e.bands for e in entries}
    setups = {e.setup for e in entries}
    bands = sorted(set(cameras.values()))
    span = f"{bands[0]}" if len(bands) == 1 else f"{bands[0]} to {bands[-1]}"
    text = f"Spectral images of {_count(objects, 'object')} by {_count(cameras, 'camera')}"
    text += f" with {span} bands" if bands != [1] else " with 1 band"
    if len(setups) > 1:
        text += f", under {len(setups)} lightings"
    text += ", registered pixel by pixel"
    scales = sorted({e.px_per_mm for e in entries if not isnan(e.px_per_mm)})
    if scales:
        low, high = f"{scales[0]:.3g}", f"{scales[-1]:.3g}"
        text += f"; {low} px per mm" if low == high else f"; {low} to {high} px per mm"
    return text + "."


def _count(things: object, word: str) -> str:
    number = len(things)  # type: ignore[arg-type]
    return f"{number} {word}" + ("" if number == 1 else "s")
