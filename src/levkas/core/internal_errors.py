"""Exceptions that no check foresaw, as refusals with a report that a user can send."""

from __future__ import annotations

import platform
import re
import traceback
from functools import partial
from pathlib import Path
from typing import Any

from levkas import __version__
from levkas.core.machine import free_memory
from levkas.core.problems import Problem, Refused

CODE = "E_INTERNAL"
HOUSE = Path(__file__).resolve().parents[1]
LONGEST_FOUND = 300
"""Characters of an exception's own text in a message; the report has all of it."""
_ADDRESS = re.compile(r"\b0x[0-9a-f]{4,}\b")


class InternalError(Refused):
    """Refusal of one capture or page for an exception that no check foresaw.

    `report` is a text to send to the authors: versions, what was worked on, the traceback.
    """

    def __init__(self, *problems: Problem, report: str = "") -> None:
        super().__init__(*problems)
        self.report = report

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), report=self.report), self.problems


def as_refusal(error: Exception, what: str, file: str | Path | None = None) -> Refused:
    """Return the refusal of `what` was worked on, of which `file` is the first frame; a refusal is returned as it is.

    >>> try:
    ...     1 / 0
    ... except ZeroDivisionError as error:
    ...     refused = as_refusal(error, "icon1/d80 calibrate", "raw/icon1.tif")
    >>> print(refused.problems[0].message)
    icon1/d80 calibrate: unexpected ZeroDivisionError
    >>> "Traceback" in refused.report and "raw/icon1.tif" in refused.report
    True
    """
    if isinstance(error, Refused):
        return error
    where = str(file) if file else None
    if isinstance(error, MemoryError):
        message, found = f"{what}: memory ran out: {error or 'no more was given'}", free_memory()
        fix = "Close other programs or use a machine with more memory, then build again. Finished stages are kept."
        return Refused(
            Problem("E_MEMORY", message, where, found=f"{found / 1e9:.1f} GB free", fix=fix)
        )
    if isinstance(error, OSError) and error.strerror:
        fix = "Check the disk, the network and the permissions, then build again. Finished stages are kept."
        where = str(error.filename) if error.filename else where
        return Refused(Problem("E_IO", f"{what}: {error.strerror}", where, fix=fix))
    text = _ADDRESS.sub("0x…", " ".join(str(error).split()))[:LONGEST_FOUND]
    message, shown = f"{what}: unexpected {type(error).__name__}", f"{text} ({_places(error)})"
    fix = "This is an error of the program: please send its report to the authors."
    problem = Problem(CODE, message, where, found=shown.strip(), fix=fix)
    return InternalError(problem, report=_report(error, what, file))


def _places(error: BaseException) -> str:
    """Return file and line that raised, and the last ones of Levkas where that was another's code."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if Path(frame.filename).is_relative_to(HOUSE)]
    places = (
        f"{'/'.join(Path(frame.filename).parts[-2:])}, line {frame.lineno}"
        for frame in (*ours[-1:], *frames[-1:])
    )
    return "; ".join(dict.fromkeys(places))


def _report(error: BaseException, what: str, file: str | Path | None) -> str:
    """Return the text to send: it names files and folders of this machine, and nothing else of it."""
    from importlib.metadata import distributions

    libraries = sorted({f"{one.metadata['Name']} {one.version}" for one in distributions()})
    lines = [
        f"Levkas {__version__}, Python {platform.python_version()}, {platform.platform()}",
        ", ".join(libraries),
        f"{what}{f': {file}' if file else ''}",
        "",
        "".join(traceback.format_exception(error)),
    ]
    return "\n".join(lines)
