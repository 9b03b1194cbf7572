"""What a stage hands back of its files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from levkas.core.problems import Problem


class Written(NamedTuple):
    """What a stage has written: its files, those beside the database, and what later stages read of it."""

    files: Iterable[Path]
    notes: dict[str, Any]
    aside: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    problems: tuple[Problem, ...] = ()
