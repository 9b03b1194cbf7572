"""The target in the names of files: what remains when all that is no target is taken off both ends."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from levkas.campaign.guess.listing import Seen
from levkas.campaign.guess.targets import (
    PARENT,
    TARGET,
    TYPED,
    Named,
    deepest,
    in_folder,
    joined,
    signature,
)
from levkas.campaign.guess.words import BANDS, IMAGES, PREFIXES, SENSORS, Token, role_of


def cluster_names(
    captures: Sequence[Seen], tokens: dict[Path, tuple[Token, ...]]
) -> list[list[Seen]]:
    """Captures whose names are made alike: of one sensor, from one folder or, where darks stand apart, two."""
    by_key: dict[tuple[object, ...], dict[tuple[str, ...], list[Seen]]] = defaultdict(dict)
    for seen in captures:
        images = tuple(t.text.lower() for t in tokens[seen.path] if t.text.lower() in IMAGES)
        key = (seen.path.suffix.lower(), signature(seen), images)
        by_key[key].setdefault(seen.folders, []).append(seen)
    clusters = []
    for folders in by_key.values():
        apart: dict[tuple[str, ...], list[Seen]] = defaultdict(list)
        for folder, group in folders.items():
            roles = {any(t.role for t in tokens[s.path]) for s in group}
            if len(roles) == 2:
                clusters.append(group)
            else:
                apart[folder[:-1]] += group
        for group in apart.values():
            if any(t.role for s in group for t in tokens[s.path]):
                clusters.append(group)
                continue
            alone: dict[tuple[str, ...], list[Seen]] = defaultdict(list)
            for seen in group:
                alone[seen.folders].append(seen)
            clusters += alone.values()
    return clusters


def find_in_stems(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> list[Named]:
    """Take from both ends of the names what is no target, in all of them at a time."""
    spans = {s.path: _trimmed(tokens[s.path], 0, len(tokens[s.path])) for s in cluster}
    worded = any(t.role for s in cluster for t in tokens[s.path])
    while _peel(cluster, tokens, spans, worded, left=True):
        pass
    while _peel(cluster, tokens, spans, worded, left=False) or _peel_number(
        cluster, tokens, spans, worded, same_scene
    ):
        pass
    return [_named(s, tokens[s.path], *spans[s.path]) for s in cluster]


def _trimmed(tokens: Sequence[Token], start: int, stop: int) -> tuple[int, int]:
    """Leave typed parts and kinds of photographs out at both ends, as long as something is left."""

    def dull(token: Token) -> bool:
        return token.kind in TYPED or token.text.lower() in IMAGES

    while start < stop and dull(tokens[start]):
        start += 1
    while stop > start and dull(tokens[stop - 1]):
        stop -= 1
    return start, stop


def _peel(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    spans: dict[Path, tuple[int, int]],
    worded: bool,
    *,
    left: bool,
) -> bool:
    """Take one part off an end of all names where it is the same in all; False where it is not."""
    ends = []
    for seen in cluster:
        start, stop = spans[seen.path]
        if stop - start < 2:
            return False
        ends.append(tokens[seen.path][start if left else stop - 1])
    texts = {t.text for t in ends}
    constant = len(texts) == 1 and not ends[0].role
    if not constant or (not worded and ends[0].text.lower() not in PREFIXES):
        return False
    for seen in cluster:
        start, stop = spans[seen.path]
        span = (start + 1, stop) if left else (start, stop - 1)
        spans[seen.path] = _trimmed(tokens[seen.path], *span)
    return all(start < stop for start, stop in spans.values())


def _peel_number(
    cluster: list[Seen],
    tokens: dict[Path, tuple[Token, ...]],
    spans: dict[Path, tuple[int, int]],
    worded: bool,
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Take a running number, or the number of a sensor, off the right end of all names."""
    ends, groups = [], defaultdict(list)
    for seen in cluster:
        start, stop = spans[seen.path]
        if stop - start < 2:
            return False
        ends.append(tokens[seen.path][stop - 1])
        others = tokens[seen.path][:start] + tokens[seen.path][stop:]
        rest = joined(tokens[seen.path][start : stop - 1]), joined(others), seen.folders
        groups[rest].append(seen)
    kinds = {(t.kind, t.before.lower()) for t in ends}
    if len(kinds) != 1 or ends[0].kind not in ("number", "numbered"):
        return False
    several = [group for group in groups.values() if len(group) > 1]
    if not (_is_sensor(ends[0]) or worded or _tell_bands(several)):
        if not several or not all(same_scene(g[0], g[-1]) for g in several[:3]):
            return False
    elif worded and not _is_sensor(ends[0]) and _are_scenes(several, tokens, same_scene):
        return False
    for seen in cluster:
        start, stop = spans[seen.path]
        spans[seen.path] = _trimmed(tokens[seen.path], start, stop - 1)
    return True


def _is_sensor(token: Token) -> bool:
    return token.kind == "numbered" and token.before.lower() in SENSORS | BANDS


def _tell_bands(groups: Iterable[list[Seen]]) -> bool:
    """Whether files that differ in a number alone are different bands by their headers."""
    told = [[s.facts.wavelengths or s.facts.band_names for s in group] for group in groups]
    return bool(told) and all(None not in t and len(set(t)) == len(t) for t in told)


def _are_scenes(
    groups: Sequence[list[Seen]],
    tokens: dict[Path, tuple[Token, ...]],
    same_scene: Callable[[Seen, Seen], bool | None],
) -> bool:
    """Whether numbers tell objects apart, not shots: among frames that are no templates."""
    objects = [g for g in groups if not any(t.role for t in tokens[g[0].path])]
    return any(same_scene(g[0], g[-1]) is False for g in objects[:3])


def _named(seen: Seen, tokens: tuple[Token, ...], start: int, stop: int) -> Named:
    if start >= stop:
        depth = len(seen.folders)
        return in_folder(seen, tokens, deepest(seen.folders) if depth else PARENT)
    roles = [i for i in range(start, stop) if tokens[i].role]
    if roles:  # what follows a dark's name in numbers are its shots
        while stop > roles[-1] + 1 and tokens[stop - 1].kind in ("number", *TYPED):
            stop -= 1
    typed = [i for i in range(start, stop) if tokens[i].kind in TYPED]
    stop = typed[0] if typed and typed[0] > start else stop
    target = joined(tokens[start:stop])
    role = role_of(tokens[roles[0]].text) if roles else "object"
    marked = Token(TARGET, tokens[start].gap, "target")
    return Named(seen, target, role, seen.folders, (*tokens[:start], marked, *tokens[stop:]))
