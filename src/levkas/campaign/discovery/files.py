"""Files that fit patterns, and, where none does, the names that came nearest."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

from levkas.campaign.discovery.folders import DEEPEST, Folders, composed, too_deep
from levkas.campaign.discovery.patterns import Pattern, natural, ways_to_read

MOST_COMPARED = 2000
TYPICAL = {"{wavelength}": "550", "{exposure}": "100", "{shot}": "001"}


@dataclass(frozen=True)
class Found:
    """A file that fits a pattern, and what its name says; units nm and s."""

    path: Path
    pattern: Pattern
    target: str = ""
    setup: str = ""
    band: str = ""
    wavelength: float | None = None
    exposure_s: float | None = None
    shot: str = ""
    sensor: str = ""


def find(
    root: Path,
    patterns: Sequence[str | Pattern],
    *,
    known: Mapping[str, Collection[str]] | None = None,
    folders: Folders | None = None,
) -> list[Found]:
    """Find the files that fit one of some patterns, in natural order; the first that fits counts.

    Parameters
    ----------
    root : Path
        What the patterns are relative to.
    patterns : sequence of str or Pattern
    known : dict of field to values, optional
        As `Pattern.read` takes it.
    folders : Folders, optional
        Listings that are already there.

    Raises
    ------
    ValueError
        For a pattern that cannot be read.
    FolderUnreadable
        For a folder that cannot be listed.
    """
    folders = folders or Folders()
    ways = ways_to_read(known or {})
    seen: dict[Path, Found] = {}
    for pattern in patterns:
        parsed = Pattern.parse(pattern) if isinstance(pattern, str) else pattern
        for path, text in _walk(parsed, folders, _start(root, parsed), 0, "", set()):
            told = None if path in seen else parsed.read(text, ways)
            if told is not None:
                seen[path] = Found(path, parsed, **told)
    return _without_data_of_headers(in_natural_order(seen.values()))


def in_natural_order(found: Iterable[Found]) -> list[Found]:
    """Return files by their paths, 9 before 10."""
    return sorted(found, key=lambda f: (natural(f.path.as_posix()), f.path.as_posix()))


def nearest(
    root: Path, pattern: Pattern, *, folders: Folders | None = None, count: int = 3
) -> tuple[Path, list[str]]:
    """Return where a pattern leads no further, and the names there that are nearest to it.

    Examples
    --------
    >>> nearest(Path("/no/such/folder"), Pattern.parse("raw/{target}.tif"))
    (PosixPath('/no/such/folder'), [])
    """
    folders = folders or Folders()
    here = [_start(root, pattern)]
    segment = pattern.segments[0]
    for i, segment in enumerate(pattern.segments):
        last = i == len(pattern.segments) - 1
        if segment == "**":
            break
        if segment == "..":
            here = [folder.parent for folder in here]
            continue
        listed = folders.files if last else folders.folders
        there = [f / n for f in here for n in listed(f) if pattern.fits_segment(i, composed(n))]
        if last or not there:
            break
        here = there
    names = [n for f in here for n in (*folders.folders(f), *folders.files(f))][:MOST_COMPARED]
    wanted = re.sub(r"\{[a-z]+\}|\*", lambda m: TYPICAL.get(m.group(), ""), segment).lower()
    ranked = sorted(
        dict.fromkeys(names),
        key=lambda n: (-SequenceMatcher(None, wanted, n.lower()).ratio(), natural(n), n),
    )
    return here[0], ranked[:count]


def _start(root: Path, pattern: Pattern) -> Path:
    return Path("/") if pattern.absolute else root


def _walk(
    pattern: Pattern,
    folders: Folders,
    folder: Path,
    index: int,
    text: str,
    been: set[tuple[int, str]],
) -> Iterator[tuple[Path, str]]:
    """Yield (path, its part that the pattern describes), one folder level a segment; no way is gone twice."""
    if (index, text) in been:
        return
    been.add((index, text))
    segment = pattern.segments[index]
    if segment == "**" and text.count("/") > DEEPEST:
        raise too_deep(folder)
    if segment == "..":
        yield from _walk(pattern, folders, folder.parent, index + 1, f"{text}../", been)
    elif segment == "**":
        yield from _walk(pattern, folders, folder, index + 1, text, been)
        for name in folders.folders(folder):
            if not folders.is_link(folder, name):
                deeper = f"{text}{composed(name)}/"
                yield from _walk(pattern, folders, folder / name, index, deeper, been)
    elif index == len(pattern.segments) - 1:
        for name in folders.files(folder):
            if pattern.fits_segment(index, composed(name)):
                yield folder / name, text + composed(name)
    elif not re.search(r"[{*]", segment):
        yield from _walk(pattern, folders, folder / segment, index + 1, f"{text}{segment}/", been)
    else:
        for name in folders.folders(folder):
            if pattern.fits_segment(index, composed(name)):
                deeper = f"{text}{composed(name)}/"
                yield from _walk(pattern, folders, folder / name, index + 1, deeper, been)


def _without_data_of_headers(found: list[Found]) -> list[Found]:
    """Leave out the data file of an ENVI header that was found too: it is one capture."""
    headers = {f.path for f in found if f.path.suffix.lower() == ".hdr"}
    if not headers:
        return found
    stems = {path.with_suffix("") for path in headers}
    return [
        f
        for f in found
        if f.path in headers or not (f.path in stems or f.path.with_suffix("") in stems)
    ]
