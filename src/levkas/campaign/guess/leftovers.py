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
        What was left out and of what it is a preview or copy, a line for each folder and kind.
    """
    places = {(c.folders, c.path.name.casefold()) for c in captures}
    measured: dict[str, list[CaptureFile]] = defaultdict(list)
    scans: dict[str, list[CaptureFile]] = defaultdict(list)
    for capture in captures:
        stem = capture.path.stem.casefold()
        if capture.path.suffix.lower() not in LOSSY:
            measured[stem].append(capture)
        if (
            capture.facts.is_cube or capture.facts.kind == "raw"
        ) and capture.facts.dtype.startswith("uint"):
            scans[stem].append(capture)
    kept: list[CaptureFile] = []
    previews: dict[tuple[str, ...], list[tuple[CaptureFile, CaptureFile]]] = defaultdict(list)
    results: dict[tuple[str, ...], list[tuple[CaptureFile, CaptureFile]]] = defaultdict(list)
    copies: list[str] = []
    for capture in captures:
        if original := _computed(capture, scans):
            results[capture.folders].append((capture, original))
        elif original := _previewed(capture, measured):
            previews[capture.folders].append((capture, original))
        elif name := _copied(capture, places):
            copies.append(f"{capture.name}: by its name a copy of {name}")
        else:
            kept.append(capture)
    lines = [_line(pairs, "a preview") for pairs in previews.values()]
    lines += [_line(pairs, "a result") for pairs in results.values()]
    return kept, [*lines, *copies]


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


def _copied(capture: CaptureFile, places: set[tuple[tuple[str, ...], str]]) -> str:
    """Return the name of the file beside it that a capture is a copy of; "" for none."""
    found = COPIES.fullmatch(capture.path.stem)
    name = f"{found['name']}{capture.path.suffix}" if found else capture.path.name
    is_there = (capture.folders, name.casefold()) in places
    return name if is_there and name != capture.path.name else ""


def _line(pairs: Sequence[tuple[CaptureFile, CaptureFile]], what: str) -> str:
    first, original = pairs[0]
    more = f" and {len(pairs) - 1} more" if len(pairs) > 1 else ""
    return f"{first.name}{more}: by its name {what} of {original.name}"
