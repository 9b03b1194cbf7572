"""Read exposures from a table beside the frames, where neither names nor EXIF have them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from levkas.campaign.discovery.captures import CaptureRefused
from levkas.core.problems import Problem
from levkas.core.text import TextRefused, read_text

EXPECTED = "a CSV with the columns file and exposure_s, in UTF-8"


def read_manifest(path: Path) -> dict[str, float]:
    """Read a CSV with the columns file and exposure_s.

    Returns
    -------
    exposures : dict of str to float, s
        By the file's name as the table has it, with ``/``.

    Raises
    ------
    CaptureRefused
        Where it cannot be read; every row without an exposure > 0 is listed, at most ten.
    """
    exposures: dict[str, float] = {}
    problems = []
    try:
        lines = io.StringIO(read_text(path, EXPECTED), newline="")
        for number, row in enumerate(csv.DictReader(lines), start=2):
            try:
                name, seconds = str(row["file"]).strip(), float(row["exposure_s"])
            except (KeyError, TypeError, ValueError):
                name, seconds = "", 0.0
            if not name or not 0 < seconds < 1e6:
                problems.append(_bad_row(path, number, row))
            exposures[name.replace("\\", "/")] = seconds
    except TextRefused as refused:
        problems = list(refused.problems)
    except csv.Error as error:
        problems = [
            Problem(
                "E_UNREADABLE",
                "the manifest cannot be read",
                str(path),
                found=str(error),
                expected=EXPECTED,
                fix="Save it again as a table of two columns.",
            )
        ]
    if problems:
        raise CaptureRefused(*problems[:10])
    return exposures


def _bad_row(path: Path, number: int, row: dict[str, str]) -> Problem:
    return Problem(
        "E_VALUE",
        f"line {number} of the manifest says no exposure",
        str(path),
        "exposure_s",
        ", ".join(str(v) for v in row.values())[:80],
        "columns file and exposure_s, in seconds",
        "Write the exposure in seconds, a number above 0.",
    )
