"""Leave out previews and copies of captures, by their names."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence

from levkas.campaign.guess.listing import CaptureFile

LOSSY = frozenset([".jpg", ".jpeg", ".png"])
"""Formats of previews; a PNG is one only beside a file of another format that bears its name."""
PREVIEWS = re.compile(r"(?i)(preview|thumb|thumbnail|quick[-_ ]?look|prox(y|ie)|web|jpe?g)s?")
"""Folders that hold previews of what lies elsewhere under the same names."""
OF_A_SCAN = frozenset(["capture", "results", "metadata"])
"""Folders of a Specim IQ within that of one scan."""
COPIES = re.compile(
    r"(?i)(?:(?:copy of|kopie von|copie de|copia de)[-_ ]+)?(?P<name>.+?)"
    r"(?:[-_ ]*\(\d+\)|[-_ ]+(?:copy|kopie|copie|copia|old|backup|bak|tmp)(?:[-_ ]*\(?\d+\)?)?)?"
)
"""What file managers and people add to the name of a copy."""


def leave_out_leftovers(
    captures: Sequence[CaptureFile],
) -> tuple[list[CaptureFile], list[str]]:
    """Leave out pictures that bear the name of a capture and show it again.

    Returns
    -------
    kept : list of CaptureFile
    left_out : list of str
        What was left out and of which file it is a preview, result or copy, a line for each folder.
    """
    places = {(c.folders, c.path.name.casefold()): c for c in captures}
    measured: dict[str, list[CaptureFile]] = defaultdict(list)
    scans: dict[str, list[CaptureFile]] = defaultdict(list)
    for capture in captures:
        stem, facts = capture.path.stem.casefold(), capture.facts
        if capture.path.suffix.lower() not in LOSSY:
            measured[stem].append(capture)
        if (facts.is_cube or facts.kind == "raw") and facts.dtype.startswith("uint"):
            scans[stem].append(capture)
    kept: list[CaptureFile] = []
    again: dict[object, list[str]] = defaultdict(list)
    for capture in captures:
        original = _computed(capture, scans) or _previewed(capture, measured)
        if original := original or _copied(capture, places):
            again[capture.folders].append(f"{capture.name} ({original.name})")
        else:
            kept.append(capture)
    return kept, [_line(names) for names in again.values()]


def _computed(capture: CaptureFile, scans: dict[str, list[CaptureFile]]) -> CaptureFile | None:
    """Return the scan or camera raw that a picture of 8 bits, or a cube of decimals, was computed from.

    Its name is part of the other's, and both lie in one folder or in one of the same folder below the root.
    """
    facts = capture.facts
    picture = facts.kind in ("tiff", "png", "jpeg") and facts.dtype == "uint8"
    if not picture and not (facts.is_cube and facts.dtype.startswith("float")):
        return None
    parts = re.split(r"([\W_]+)", capture.path.stem.casefold())
    runs = ("".join(parts[i:j]) for i in range(0, len(parts), 2) for j in range(len(parts), i, -2))
    for scan in (scan for run in runs for scan in scans.get(run, ())):
        here, there = _tree(capture), _tree(scan)
        if here == there or here[:1] == there[:1] != ():
            return scan
    return None


def _tree(capture: CaptureFile) -> tuple[str, ...]:
    """Return the folders of a capture without those that a scanner makes in each scan's."""
    return tuple(name for name in capture.folders if name.lower() not in OF_A_SCAN)


def _previewed(capture: CaptureFile, measured: dict[str, list[CaptureFile]]) -> CaptureFile | None:
    """Return the capture that a picture is a preview of: of its name, beside it or anywhere."""
    if capture.path.suffix.lower() not in LOSSY:
        return None
    named = measured.get(capture.path.stem.casefold(), [])
    anywhere = any(PREVIEWS.fullmatch(folder) for folder in capture.folders)
    return next((c for c in named if anywhere or c.folders == capture.folders), None)


def _copied(
    capture: CaptureFile, places: dict[tuple[tuple[str, ...], str], CaptureFile]
) -> CaptureFile | None:
    """Return the file beside it that a capture is a copy of."""
    found = COPIES.fullmatch(capture.path.stem)
    name = f"{found['name']}{capture.path.suffix}" if found else capture.path.name
    return places.get((capture.folders, name.casefold())) if name != capture.path.name else None


def _line(names: Sequence[str]) -> str:
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{names[0]}{more}: by its name a preview, a result or a copy of another file"
