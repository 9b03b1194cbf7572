"""Names of files as patterns: ``raw/d80/{target}/{wavelength}nm_{exposure}ms_*.tif``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
FIELDS = ("target", "setup", "band", "wavelength", "exposure", "shot", "sensor")
_NUMBER = r"\d+(?:\.\d+)?"
_ANY = r"[^/]+?"


@dataclass(frozen=True)
class Found:
    """A file that fits a pattern, and what its name says."""

    path: Path
    target: str
    setup: str = ""
    band: str = ""
    wavelength: float | None = None
    exposure_s: float | None = None
    shot: str = ""
    sensor: str = ""


def natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key that puts 9 before 10.

    >>> sorted(["b10", "b9", "a"], key=natural)
    ['a', 'b9', 'b10']
    """
    parts = re.split(r"(\d+)", text)
    return [(0, int(p), p) if p.isdigit() else (1, 0, p) for p in parts if p]


def find(root: Path, patterns: Sequence[str], targets: Sequence[str] = ()) -> list[Found]:
    """Find the files that fit one of some patterns, in natural order; the first that fits counts.

    Parameters
    ----------
    root : Path
        What the patterns are relative to.
    patterns : sequence of str
        ``{target}``, ``{setup}``, ``{band}``, ``{wavelength}``, ``{exposure}``, ``{shot}`` and
        ``{sensor}`` stand for a part of a name, ``*`` for any part, ``**`` for any folders.
        ``{exposure}`` takes its unit from the letters behind it, seconds without any.
    targets : sequence of str
        Known values of ``{target}``: preferred where a name could be read in two ways.

    Raises
    ------
    ValueError
        For an unknown placeholder.
    """
    seen: dict[Path, Found] = {}
    for pattern in patterns:
        segments = [s for s in pattern.replace("\\", "/").split("/") if s not in ("", ".")]
        start = Path("/") if pattern.startswith("/") else root
        for path, text in _walk(start, segments):
            if path in seen:
                continue
            told = _match("/".join(segments), text, targets)
            if told is not None:
                seen[path] = Found(path, **told)
    return sorted(seen.values(), key=lambda f: natural(f.path.as_posix()))


def _walk(folder: Path, segments: list[str]) -> Iterator[tuple[Path, str]]:
    """Yield (path, its part that the segments describe), one folder level a segment."""
    head, rest = segments[0], segments[1:]
    if head == "..":
        for path, text in _walk(folder.parent, rest):
            yield path, f"../{text}"
        return
    plain = not re.search(r"[{*?]", head)
    if plain and rest:
        for path, text in _walk(folder / head, rest) if (folder / head).is_dir() else ():
            yield path, f"{head}/{text}"
        return
    try:
        entries = sorted(os.scandir(folder), key=lambda e: e.name)
    except OSError:
        return
    if head == "**":
        yield from _walk(folder, rest)
        for entry in entries:
            if entry.is_dir() and not entry.name.startswith("."):
                yield from ((p, f"{entry.name}/{t}") for p, t in _walk(Path(entry.path), segments))
        return
    shape = re.compile(_regex(head, (), named=False), re.IGNORECASE)
    for entry in entries:
        if entry.name.startswith(".") or not shape.fullmatch(entry.name):
            continue
        if rest and entry.is_dir():
            yield from ((p, f"{entry.name}/{t}") for p, t in _walk(Path(entry.path), rest))
        elif not rest and entry.is_file():
            yield folder / entry.name, entry.name


def _match(pattern: str, text: str, targets: Sequence[str]) -> dict[str, object] | None:
    """Read the fields out of one name; None where a placeholder would mean two things."""
    for known in (targets, ()) if targets else ((),):
        if found := re.fullmatch(_regex(pattern, known), text, re.IGNORECASE):
            break
    else:
        return None
    told: dict[str, object] = {}
    for name, value in found.groupdict().items():
        if name.startswith("unit"):
            continue
        told[name] = value
    if "exposure" in told:
        told["exposure_s"] = float(str(told.pop("exposure"))) * UNITS[exposure_unit(pattern)]
    if "wavelength" in told:
        told["wavelength"] = float(str(told["wavelength"]))
    return told


def exposure_unit(pattern: str) -> str:
    """Return the unit behind ``{exposure}``.

    >>> exposure_unit("{target}_{exposure}ms_*.tif")
    'ms'
    """
    found = re.search(r"\{exposure\}(ms|us|µs|sec|s)?(?![a-z])", pattern, re.IGNORECASE)
    return (found.group(1) or "").lower() if found else ""


def _regex(pattern: str, targets: Sequence[str], *, named: bool = True) -> str:
    out, used = [], set()
    for part in re.split(r"(\{[^}]*\}|\*\*/?|\*|\?)", pattern):
        if part.startswith("{"):
            name = part[1:-1]
            if name not in FIELDS:
                raise ValueError(f"unknown placeholder {part}; known: {', '.join(FIELDS)}")
            body = _NUMBER if name in ("wavelength", "exposure") else _ANY
            if name == "shot":
                body = r"[^/]*?"
            if name == "target" and targets:
                body = "|".join(re.escape(t) for t in sorted(targets, key=len, reverse=True))
            if not named:
                out.append(f"(?:{body})")
            elif name in used:
                out.append(f"(?P={name})")
            else:
                out.append(f"(?P<{name}>{body})")
                used.add(name)
        elif part.startswith("**"):
            out.append(r"(?:.*/)?")
        elif part == "*":
            out.append(r"[^/]*")
        elif part == "?":
            out.append(r"[^/]")
        else:
            out.append(re.escape(part))
    return "".join(out)
