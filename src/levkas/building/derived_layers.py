"""Layers of a database that were made from others: those that no longer fit their sources stay, marked."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from levkas.core.problems import Refused
from levkas.core.text import counted, read_json
from levkas.database.catalogue import MEASURED
from levkas.database.layout import KINDS, MADE_OF, LayerId
from levkas.database.manifest import walk_files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from levkas.building.build_records import BuildRecords
    from levkas.database.catalogue import Entry
    from levkas.database.layout import Places


AGAIN = "Make it again from its sources, an estimated one by `levkas estimate apply`"


class Outdated(NamedTuple):
    """Why a layer made from others is not of what the database holds now, and whether it goes."""

    why: str
    goes: bool = False

    def describe(self, layer: LayerId) -> str:
        """Return the warning of one that stays."""
        return f"{layer.object}/{layer.name}: of an earlier build: {self.why}. {AGAIN}"


def outdated_layers(
    places: Places, entries: Sequence[Entry], has_left: Callable[[str], bool]
) -> dict[LayerId, Outdated]:
    """Return the layers made from others that are not of what the database holds now, and why.

    `entries` has the rows of measured layers as they are now. `has_left` tells whether campaign.toml no longer names an
    object: its layers go, as one does whose name a camera takes.
    """
    measured = {entry.layer: entry.sha256 for entry in entries if entry.kind == MEASURED}
    found = {}
    for layer, kind in ((entry.layer, entry.kind) for entry in entries if entry.kind != MEASURED):
        if has_left(layer.object):
            found[layer] = Outdated(f"{layer.object} is no longer in the campaign", goes=True)
        elif layer in measured:
            found[layer] = Outdated("a camera of the campaign has its name", goes=True)
        elif why := _why_outdated(places, layer, kind, measured):
            found[layer] = Outdated(why)
    return found


def _why_outdated(
    places: Places, layer: LayerId, kind: str, measured: Mapping[LayerId, str]
) -> str:
    try:
        sources = dict(read_json(places.output / f"{layer.path}{MADE_OF[kind]}")["sources"])
    except (Refused, OSError, KeyError, TypeError, ValueError):
        return "its record cannot be read"
    for name, sha256 in sources.items():
        now = measured.get(LayerId.parse(layer.object, name))
        if now is None:
            return f"its source {name} is not in the database any more"
        if now != sha256:
            return f"its source {name} was built again"
    return ""


def describe_outdated(outdated: Mapping[LayerId, Outdated]) -> str:
    """Report in a line what is outdated; empty for nothing."""
    if not outdated:
        return ""
    first, one = next(iter(outdated.items()))
    more = f" and {len(outdated) - 1} more" if len(outdated) > 1 else ""
    return f"{counted(len(outdated), 'layer')} made from others: {first.object}/{first.name}{more}, {one.why}"


def put_away_outdated(
    places: Places, records: BuildRecords, outdated: Mapping[LayerId, Outdated]
) -> tuple[str, ...]:
    """Move outdated layers out of the database; return a warning for each."""
    warnings = []
    for layer, (why, _) in outdated.items():
        where = records.put_away(_files_of(places, layer))
        warnings.append(
            f"{layer.object}/{layer.name}: made from others, and {why}; it was moved to "
            f"{where or 'nowhere: its files are gone'}. {AGAIN}"
        )
    return tuple(warnings)


def _files_of(places: Places, layer: LayerId) -> Iterator[str]:
    """Yield the names of the files of a layer that was made from others."""
    endings = (*KINDS.values(), ".png", *MADE_OF.values())
    yield from (f"{layer.path}{ending}" for ending in endings)
    group = places.output / layer.group
    if group.is_dir():
        yield from (f"{layer.group}/{name}" for name in walk_files(group))
