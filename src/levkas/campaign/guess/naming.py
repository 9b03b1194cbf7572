"""Where in the names of files the target stands: in a folder's name, or in a part of the file's own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

from levkas.campaign.guess.listing import Seen
from levkas.campaign.guess.stems import cluster_names, find_in_stems
from levkas.campaign.guess.targets import STEM, Named, deepest, in_folder, signature
from levkas.campaign.guess.words import (
    BANDS,
    GENERIC,
    IMAGES,
    PREFIXES,
    SENSORS,
    Token,
    role_in,
    tokens_of,
)


def name_targets(
    captures: Sequence[Seen], *, same_scene: Callable[[Seen, Seen], bool | None]
) -> list[Named]:
    """Find the target of every capture.

    Parameters
    ----------
    captures : sequence of Seen
    same_scene : callable
        Whether two captures show the same; asked where running numbers may be shots or objects.
    """
    if not captures:
        return []
    tokens = {s.path: tokens_of(s.stem) for s in captures}
    places = _places(captures, tokens, same_scene)
    named = [
        in_folder(s, tokens[s.path], places[s.path]) for s in captures if places[s.path] != STEM
    ]
    in_stem = [s for s in captures if places[s.path] == STEM]
    for cluster in cluster_names(in_stem, tokens):
        named += find_in_stems(cluster, tokens, same_scene)
    order = {s.path: i for i, s in enumerate(captures)}
    return sorted(named, key=lambda n: order[n.seen.path])


# --- which part of a path ---------------------------------------------------------------------


def _places(
    captures: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> dict[Path, int]:
    """Return the place of each capture's target: the index of a folder, `STEM` or `PARENT`."""
    siblings: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for seen in captures:
        for i, name in enumerate(seen.folders):
            siblings[seen.folders[:i]].add(name)
    places: dict[Path, int] = {}
    for seen in captures:
        told = [i for i, name in enumerate(seen.folders) if role_in(name)]
        in_stem = any(t.role for t in tokens[seen.path])
        if told:
            others = siblings[seen.folders[: told[-1]]] - {seen.folders[told[-1]]}
            generic = in_stem and any(name.lower() in GENERIC for name in others)
            places[seen.path] = STEM if generic else told[-1]
        elif in_stem:
            places[seen.path] = STEM
    worded = [s for s in captures if s.path in places]
    rest = [s for s in captures if s.path not in places]
    for seen in rest:
        place = _beside(seen, worded, places)
        if place is not None:
            places[seen.path] = place
    for depth in {len(s.folders) for s in rest}:
        group = [s for s in rest if len(s.folders) == depth and s.path not in places]
        if group:
            places |= _untold(group, tokens, same_scene)
    return places


def _beside(seen: Seen, worded: Sequence[Seen], places: dict[Path, int]) -> int | None:
    """The place that darks and whites in the same folders have."""
    levels = [
        places[w.path]
        for w in worded
        if 0 <= places[w.path] < len(seen.folders)
        and w.folders[: places[w.path]] == seen.folders[: places[w.path]]
    ]
    for level in sorted(set(levels), reverse=True):
        while level < len(seen.folders) and seen.folders[level].lower() in GENERIC:
            level += 1
        if level < len(seen.folders):
            return level
    near = [w for w in worded if places[w.path] == STEM and w.folders[:-1] == seen.folders[:-1]]
    return STEM if near else None


def _untold(
    group: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> dict[Path, int]:
    """Places where no dark or white says them: by what repeats from folder to folder."""
    depth = len(group[0].folders)
    words = {s.path: _words(tokens[s.path]) for s in group}
    by_folder: dict[tuple[str, ...], set[tuple[str, ...]]] = defaultdict(set)
    for seen in group:
        by_folder[seen.folders].add(words[seen.path])
    if not any(words.values()):
        level = _level(group) if depth else None
        if level is None and _are_numbers(group, tokens, same_scene):
            level = STEM
        if level is None:
            level = deepest(group[0].folders)
        return {s.path: level for s in group}
    level = STEM
    repeats = len(by_folder) > 1 and len({frozenset(w) for w in by_folder.values()}) == 1
    if repeats and depth:
        by_word = {w: {signature(s) for s in group if words[s.path] == w} for w in words.values()}
        of_images = all(set(w) <= IMAGES for w in words.values())
        differ = len({frozenset(v) for v in by_word.values()}) > 1
        if of_images or (differ and all(len(v) == 1 for v in by_word.values())):
            level = deepest(group[0].folders)
    return {s.path: level for s in group}


def _words(tokens: Sequence[Token]) -> tuple[str, ...]:
    """Words of a name that may tell an object: no numbers, units, or what cameras write."""
    words = [t.before.lower() if t.kind == "numbered" else t.text.lower() for t in tokens]
    kept = [w for t, w in zip(tokens, words, strict=True) if t.kind in ("word", "numbered")]
    numbered = {t.before.lower() for t in tokens if t.kind == "numbered"}
    dull = PREFIXES | (numbered & (SENSORS | BANDS))
    return tuple(w for w in kept if w not in dull)


def _level(group: Sequence[Seen]) -> int | None:
    """The deepest folder whose names differ while the sensors' sizes are the same under each."""
    for level in reversed(range(len(group[0].folders))):
        same: dict[tuple[str, ...], dict[str, set[object]]] = defaultdict(lambda: defaultdict(set))
        for seen in group:
            rest = (*seen.folders[:level], *seen.folders[level + 1 :])
            same[rest][seen.folders[level]].add(signature(seen))
        for values in same.values():
            if len(values) > 1 and len({frozenset(v) for v in values.values()}) == 1:
                return level
    return None


def _are_numbers(
    group: Sequence[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Whether running numbers are all that tells different scenes apart."""
    plain = [s for s in group if not any(t.kind == "wavelength" for t in tokens[s.path])]
    numbers = all(any(t.kind in ("number", "numbered") for t in tokens[s.path]) for s in plain)
    if len(plain) != len(group) or not numbers or len(group) < 2:
        return False
    alike = [s for s in group[1:] if signature(s) == signature(group[0])]
    return any(same_scene(group[0], s) is False for s in (alike[0], alike[-1])) if alike else True
