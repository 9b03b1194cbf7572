"""How a plan is refused: what was found, what is expected, and what is asked rather than assumed."""

from __future__ import annotations

from typing import Any

from levkas.core.problems import Problem, Refused

EXPLAINED = "docs/planning.md explains every key."


class PlanRefused(Refused):
    """A setup that cannot be planned; every reason is listed."""


def wrong(
    file: str, field: str, message: str, found: Any = None, expected: Any = None,
    fix: str = EXPLAINED, code: str = "E_VALUE",
) -> Problem:  # fmt: skip
    """Return a value's problem."""
    return Problem(code, message, file, field, _plain(found), expected, fix)


def asked(file: str, field: str, found: Any, expected: Any, meant: str, fix: str = "") -> Problem:
    """Return a question about a unit: the value is possible, but hardly meant.

    >>> print(asked("bench.toml", "cameras.a.focal_mm", 6, "8 to 1,000 mm", "6 cm"))
    is 6 cm meant? (file: bench.toml; field: cameras.a.focal_mm; found: 6; expected: 8 to 1,000 mm). ...
    """
    key = field.rpartition(".")[2]
    fix = fix or f"Write {key} in its unit; nothing is assumed."
    return Problem("E_UNIT", f"is {meant} meant?", file, field, _plain(found), expected, fix)


def _plain(value: Any) -> Any:
    """A list as text: problems are compared, which lists cannot be."""
    return str(value) if isinstance(value, list | tuple) else value
