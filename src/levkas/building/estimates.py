"""Estimated layers of a database: those that no longer fit the layers that they were made from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.core.problems import Refused
from levkas.core.text import counted, read_json
from levkas.database.catalogue import ESTIMATED
from levkas.database.layout import ESTIMATE, KINDS, LayerId
from levkas.database.manifest import walk_files

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from levkas.building.build_records import BuildRecords
    from levkas.database.catalogue import Entry
    from levkas.database.layout import Places


def outdated_estimates(
    places: Places, entries: Sequence[Entry], names: Collection[str] | None
) -> dict[LayerId, str]:
    """Return the estimated layers that are not of what the database holds now, and why.

    Parameters
    ----------
    places : Places
    entries : sequence of Entry
        Rows of the catalogue, those of measured layers as they are now.
    names : collection of str, optional
        Objects of the campaign; None where others may be in the database.
    """
    measured = {entry.layer: entry.sha256 for entry in entries if entry.kind != ESTIMATED}
    found = {}
    for layer in (entry.layer for entry in entries if entry.kind == ESTIMATED):
        if names is not None and layer.object not in names:
            found[layer] = f"{layer.object} is no longer in the campaign"
        elif layer in measured:
            found[layer] = "a camera of the campaign has its name"
        elif why := _why_outdated(places, layer, measured):
            found[layer] = why
    return found


def _why_outdated(places: Places, layer: LayerId, measured: Mapping[LayerId, str]) -> str:
    try:
        sources = dict(read_json(places.output / f"{layer.path}{ESTIMATE}")["sources"])
    except (Refused, OSError, KeyError, TypeError, ValueError):
        return "its record cannot be read"
    for name, sha256 in sources.items():
        now = measured.get(LayerId.parse(layer.object, name))
        if now is None:
            return f"its source {name} is not in the database any more"
        if now != sha256:
            return f"its source {name} was built again"
    return ""


def describe_outdated(outdated: Mapping[LayerId, str]) -> str:
    """Report in a line what is outdated; empty for nothing."""
    if not outdated:
        return ""
    first, why = next(iter(outdated.items()))
    more = f" and {len(outdated) - 1} more" if len(outdated) > 1 else ""
    return f"{counted(len(outdated), 'estimated layer')}: {first.object}/{first.name}{more}, {why}"


def put_away_estimates(
    places: Places, records: BuildRecords, outdated: Mapping[LayerId, str]
) -> tuple[str, ...]:
    """Move outdated estimated layers out of the database; return a warning for each."""
    warnings = []
    for layer, why in outdated.items():
        where = records.put_away(_files_of(places, layer))
        warnings.append(
            f"{layer.object}/{layer.name}: this layer is estimated, and {why}; it was moved to "
            f"{where or 'nowhere: its files are gone'}. `levkas estimate apply` makes it again"
        )
    return tuple(warnings)


def _files_of(places: Places, layer: LayerId) -> Iterator[str]:
    """Yield the names of the files of an estimated layer."""
    yield from (f"{layer.path}{ending}" for ending in (*KINDS.values(), ".png", ESTIMATE))
    group = places.output / layer.group
    if group.is_dir():
        yield from (f"{layer.group}/{name}" for name in walk_files(group))
