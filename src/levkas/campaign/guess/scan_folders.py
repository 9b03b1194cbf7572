"""Folders that hold one object each with its own darks and whites, as scanners and tethered sessions leave them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from levkas.campaign.guess.band_names import Tokens
from levkas.campaign.guess.listing import CaptureFile
from levkas.campaign.guess.pixels import Samples
from levkas.campaign.guess.words import GENERIC, IMAGES, LIGHTS, TARGET, plain, role_in

TEMPLATES = ("dark", "white")


@dataclass(frozen=True)
class ScanFolder:
    """One object's folder.

    Parameters
    ----------
    object : str
        Its name.
    inside : tuple of str
        The folder, below the root.
    folders : tuple of str
        The same as patterns, with ``{target}`` in the object's place.
    objects, templates : tuple of CaptureFile
        Frames of the object, and its darks and whites.
    """

    object: str
    inside: tuple[str, ...]
    folders: tuple[str, ...]
    objects: tuple[CaptureFile, ...]
    templates: tuple[CaptureFile, ...]


class Home(NamedTuple):
    """Frames of objects, and darks and whites, in one folder."""

    objects: list[CaptureFile]
    templates: list[CaptureFile]


Homes = Mapping[tuple[str, ...], Home]


def find_scan_folders(
    captures: Sequence[CaptureFile], tokens: Tokens, samples: Samples
) -> list[ScanFolder]:
    """Find folders beside one another of which each has one object of one sensor, a dark or a white.

    A folder whose object has a name of its own, which the folders beside it have, too, is a camera's or a
    lighting's and not found. One folder alone is, where file and folder bear the object's name.
    """
    found: list[ScanFolder] = []
    for level, homes in _alike(_homes(captures, tokens)):
        names = [folders[level] for folders in homes]
        if all(LIGHTS.fullmatch(n) for n in names) or {n.lower() for n in names} & IMAGES:
            continue
        words = [_word_of(home.objects, tokens, samples) for home in homes.values()]
        named = [_named(n, w) if w is not None else None for n, w in zip(names, words, strict=True)]
        sizes = [{c.signature for c in home.objects} for home in homes.values()]
        alone = len(homes) == 1 and words[0] != names[0]
        if None in named or alone or not set.intersection(*sizes):
            continue
        found += _scans(level, homes, [one for one in named if one is not None])
    return found


def _scans(level: int, homes: Homes, named: Sequence[tuple[str, str]]) -> Iterator[ScanFolder]:
    """Yield the folders of some objects: their names, what stands before these in the folders', and the folders."""
    within = all(prefix for _, prefix in named) and len({name for name, _ in named}) == len(named)
    own = f"{_pattern_of([prefix for _, prefix in named])}{TARGET}" if within else TARGET
    above = [{folders[i] for folders in homes} for i in range(level)]
    patterns = tuple(next(iter(names)) if len(names) == 1 else "*" for names in above)
    for (name, _), (folders, home) in zip(named, homes.items(), strict=True):
        yield ScanFolder(
            name if within else folders[level],
            folders[: level + 1],
            (*patterns, own),
            tuple(home.objects),
            tuple(home.templates),
        )


def _homes(captures: Sequence[CaptureFile], tokens: Tokens) -> dict[tuple[str, ...], Home]:
    """Return the folders that hold darks or whites and other frames of their size, with both."""
    homes: dict[tuple[str, ...], Home] = defaultdict(lambda: Home([], []))
    for capture in captures:
        folders = capture.folders
        role = next((t.role for t in tokens[capture.path] if t.role), "")
        if folders and role_in(folders[-1]) in TEMPLATES:
            homes[folders[:-1]].templates.append(capture)
        elif role in TEMPLATES:
            homes[folders].templates.append(capture)
        elif role != "chart":
            homes[folders].objects.append(capture)
            if folders and folders[-1].lower() in GENERIC:
                homes[folders[:-1]].objects.append(capture)
    whole: dict[tuple[str, ...], Home] = {}
    for folders, home in homes.items():
        sizes = {c.signature for c in home.templates}
        same = [c for c in home.objects if c.signature in sizes]
        if folders and same and home.templates:
            whole[folders] = Home(same, home.templates)
    return whole


def _alike(homes: Homes) -> Iterator[tuple[int, Homes]]:
    """Yield homes that differ in the name of one folder, the deepest that differs, with its level; then those in which
    folders above it differ, too, as dates do; then single ones, at every level."""
    left = dict(homes)
    for apart in (False, True):
        for level in reversed(range(max(map(len, homes), default=0))):
            groups: dict[object, dict[tuple[str, ...], Home]] = defaultdict(dict)
            for folders, home in left.items():
                if len(folders) > level:
                    above = level if apart else folders[:level]
                    groups[above, folders[level + 1 :]][folders] = home
            for group in groups.values():
                if len({folders[level] for folders in group}) == len(group) > 1:
                    yield level, group
                    left = {folders: home for folders, home in left.items() if folders not in group}
    for folders, home in left.items():
        yield from ((level, {folders: home}) for level in reversed(range(len(folders))))


def _word_of(objects: Sequence[CaptureFile], tokens: Tokens, samples: Samples) -> str | None:
    """Return what names the object of a folder in its files' names; "" for nothing, None for several objects."""
    words, counts = set(), set()
    for capture in objects:
        parts = tokens[capture.path]
        words.add("_".join(t.text for t in parts if t.word and t.word.lower() not in GENERIC))
        counts.add(tuple(t.text for t in parts if t.kind in ("wavelength", "band", "sensor")))
    if len(words) > 1:
        return None
    (word,), first = words, objects[0]
    if len(objects) == 1:
        parts = tokens[first.path]
        return word or (parts[0].text if len(parts) == 1 and parts[0].kind == "number" else "")
    shots = len(counts) == 1 and not first.facts.is_cube  # of a scan several files are strips
    return None if shots and samples.difference(objects) else word


def _named(folder: str, word: str) -> tuple[str, str] | None:
    """Return the name of the object, and what stands before it in the folder's; None where that has another name.

    >>> _named("2024-05-31_icon1", "icon1"), _named("001", "001"), _named("painting 1", "")
    (('icon1', '2024-05-31_'), ('001', ''), ('painting 1', ''))
    >>> _named("d80", "icon1")
    """
    if word and plain(word) not in plain(folder):
        return None
    prefix = folder.removesuffix(word) if word else ""
    apart = prefix != folder and prefix and not prefix[-1].isalnum()
    return (word, prefix) if apart else (folder, "")


def _pattern_of(prefixes: Sequence[str]) -> str:
    """Return a pattern for some texts: itself if it is one, else a star and what separates all of them from what follows.

    >>> _pattern_of(["2024-05-30_", "2024-05-31_"])
    '*_'
    """
    if len(set(prefixes)) == 1:
        return prefixes[0]
    ends = {re.split(r"[^\W_]", prefix)[-1] for prefix in prefixes}
    return f"*{ends.pop()}" if len(ends) == 1 else "*"
