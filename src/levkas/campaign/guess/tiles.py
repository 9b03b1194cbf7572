"""Tiles in the names of files: ``r02c03``, ``row2_col3``, ``Grid@0 1``, as folders or at the end of an object's name."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from levkas.campaign.guess.names import NamedFile
from levkas.campaign.guess.words import PLACE, TARGET, Token

AT_END = re.compile(
    rf"(?P<name>.*[^-_\s\[(])(?P<gap>[-_\s]*[\[(]|[-_\s]+)(?P<place>{PLACE.pattern})(?P<end>[\])]?)"
)
FEWEST = 2
"""Tiles of one object; of one it may be a part of its name."""


def mark_tiles(named: Sequence[NamedFile]) -> list[NamedFile]:
    """Return files with the tiles in their paths marked, where an object has several.

    A folder below the object's that is a place becomes the pattern of one, ``r{row}c{column}``; so does a place at the end of an object's name.
    """
    marked = [_marked(one) for one in named]
    tiles: dict[object, set[str]] = defaultdict(set)
    for new, tile in marked:
        if tile:
            tiles[new.target, new.folders, new.path.suffix.lower()].add(tile)
    return [
        new if len(tiles[new.target, new.folders, new.path.suffix.lower()]) >= FEWEST else old
        for old, (new, _) in zip(named, marked, strict=True)
    ]


def pattern_of(text: str) -> str:
    """Return the pattern of a place: its numbers replaced by fields; empty where it is none.

    >>> pattern_of("r02c3"), pattern_of("Grid@0 1"), pattern_of("recto")
    ('r{row}c{column}', 'Grid@{row} {column}', '')
    """
    found = PLACE.fullmatch(text)
    if found is None:
        return ""
    if found["row"] is not None:
        return f"{found['a']}{{row}}{found['b']}{{column}}"
    return f"{found['c']}{{row}}{found['d']}{{column}}"


def _marked(one: NamedFile) -> tuple[NamedFile, str]:
    """Return a file with its tile marked, and the tile's text; empty where it has none."""
    if one.role != "object":
        return one, ""
    for place, folder in enumerate(one.folders):
        if TARGET in one.folders[:place] and (pattern := pattern_of(folder)):
            folders = (*one.folders[:place], pattern, *one.folders[place + 1 :])
            return replace(one, folders=folders, tile=folder), folder
    at = one.folders.index(TARGET) if TARGET in one.folders else 0
    if at and (pattern := pattern_of(one.target)):
        above = one.folders[
            at - 1
        ]  # the folder is the place alone: the one above it is the object's
        folders = (*one.folders[: at - 1], TARGET, pattern, *one.folders[at + 1 :])
        return replace(one, target=above, folders=folders, tile=one.target), one.target
    whole = [n for n, token in enumerate(one.stem) if token.kind == "target"]
    if whole and one.folders and (pattern := pattern_of(one.target)):
        here = one.stem[whole[0]]  # the name is the place alone: the folder is the object's
        stem = (*one.stem[: whole[0]], Token(pattern, here.gap, "tile"), *one.stem[whole[0] + 1 :])
        folders = (*one.folders[:-1], TARGET)
        marked = replace(one, target=one.folders[-1], folders=folders, stem=stem, tile=one.target)
        return marked, one.target
    found = AT_END.fullmatch(one.target)
    if found is None:
        return one, ""
    tile = Token(pattern_of(found["place"]) + found["end"], found["gap"], "tile")
    places = [n for n, token in enumerate(one.stem) if token.kind == "target"]
    if not places:
        return one, ""
    stem = (*one.stem[: places[0] + 1], tile, *one.stem[places[0] + 1 :])
    name, tile_name = found["name"], found["place"]
    return replace(one, target=name, stem=stem, tile=tile_name), tile_name
