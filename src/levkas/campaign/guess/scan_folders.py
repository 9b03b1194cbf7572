"""Folders that hold one object each with its own darks and whites, as scanners and tethered sessions leave them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from levkas.campaign.guess.band_names import Tokens
from levkas.campaign.guess.listing import CaptureFile
from levkas.campaign.guess.words import GENERIC, IMAGES, LIGHTS, TARGET, plain, role_in

TEMPLATES = ("dark", "white")


@dataclass(frozen=True)
class ScanFolder:
    """One object's folder.

    Parameters
    ----------
    object : str
        Its name.
    level : int
        Of the folder, below the root.
    folder : str
        The folder's name with ``{target}`` in the object's place, the rest as a pattern.
    objects, templates : tuple of CaptureFile
        Frames of the object, and its darks and whites.
    """

    object: str
    level: int
    folder: str
    objects: tuple[CaptureFile, ...]
    templates: tuple[CaptureFile, ...]


def find_scan_folders(captures: Sequence[CaptureFile], tokens: Tokens) -> list[ScanFolder]:
    """Find folders beside one another of which each has one object of one sensor, a dark or a white.

    A folder of which the object has a name of its own that the folders beside it have, too, is a camera's or a
    lighting's and not found.
    """
    found: list[ScanFolder] = []
    for level, homes in _alike(_homes(captures, tokens)):
        names = [home[level] for home in homes]
        if all(LIGHTS.fullmatch(n) for n in names) or {n.lower() for n in names} & IMAGES:
            continue
        words = [_word_of(objects, tokens) for objects, _ in homes.values()]
        if not all(
            word is not None and (not word or plain(word) in plain(name))
            for word, name in zip(words, names, strict=True)
        ):
            continue
        sizes = [{c.signature for c in objects} for objects, _ in homes.values()]
        if not set.intersection(*sizes):
            continue
        named = [_named(name, word or "") for name, word in zip(names, words, strict=True)]
        within = all(prefix for _, prefix in named) and len({name for name, _ in named}) == len(
            named
        )
        folder = f"{_pattern_of([prefix for _, prefix in named])}{TARGET}" if within else TARGET
        for (name, _), whole, (objects, templates) in zip(
            named, names, homes.values(), strict=True
        ):
            found.append(
                ScanFolder(
                    name if within else whole, level, folder, tuple(objects), tuple(templates)
                )
            )
    return found


Home = tuple[list[CaptureFile], list[CaptureFile]]
"""Frames of objects, darks and whites in one folder."""


def _homes(captures: Sequence[CaptureFile], tokens: Tokens) -> dict[tuple[str, ...], Home]:
    """Return the folders that hold darks or whites and other frames of their size, with both."""
    homes: dict[tuple[str, ...], Home] = defaultdict(lambda: ([], []))
    for capture in captures:
        folders, role = capture.folders, _role_of(capture, tokens)
        if folders and role_in(folders[-1]) in TEMPLATES:
            homes[folders[:-1]][1].append(capture)
        elif role in TEMPLATES:
            homes[folders][1].append(capture)
        elif folders and folders[-1].lower() in GENERIC and role != "chart":
            homes[folders[:-1]][0].append(capture)
            homes[folders][0].append(capture)
        elif role != "chart":
            homes[folders][0].append(capture)
    whole: dict[tuple[str, ...], Home] = {}
    for folders, (objects, templates) in homes.items():
        sizes = {c.signature for c in templates}
        same = [c for c in objects if c.signature in sizes]
        if folders and same and templates:
            whole[folders] = same, templates
    return whole


def _role_of(capture: CaptureFile, tokens: Tokens) -> str:
    return next((t.role for t in tokens[capture.path] if t.role), "")


def _alike(
    homes: Mapping[tuple[str, ...], Home],
) -> Iterator[tuple[int, dict[tuple[str, ...], Home]]]:
    """Yield homes that differ in the name of one folder, the deepest that differs, with its level."""
    left = dict(homes)
    for level in reversed(range(max(map(len, homes), default=0))):
        groups: dict[tuple[str, ...], dict[tuple[str, ...], Home]] = defaultdict(dict)
        for folders, home in left.items():
            if len(folders) > level:
                groups[(*folders[:level], "\0", *folders[level + 1 :])][folders] = home
        for group in groups.values():
            if len(group) > 1:
                yield level, group
                left = {folders: home for folders, home in left.items() if folders not in group}


def _word_of(objects: Sequence[CaptureFile], tokens: Tokens) -> str | None:
    """Return what names the object of a folder in its files' names; "" for nothing, None for several objects."""
    words = set()
    for capture in objects:
        parts = tokens[capture.path]
        own = [t.text for t in parts if t.word and t.word.lower() not in GENERIC]
        alone = parts[0].text if len(parts) == 1 and parts[0].kind == "number" else ""
        words.add("_".join(own) or alone)
    return words.pop() if len(words) == 1 else None


def _named(folder: str, word: str) -> tuple[str, str]:
    """Return the name of the object, and what stands before it in the folder's.

    >>> _named("2024-05-31_icon1", "icon1"), _named("001", "001"), _named("painting 1", "")
    (('icon1', '2024-05-31_'), ('001', ''), ('painting 1', ''))
    """
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
