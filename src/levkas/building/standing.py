"""What an earlier build made of a layer, and whether it may stay where the disk refuses the new one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.core.disk import DISK_CODES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from levkas.building.ledger import Key, Ledger
    from levkas.core.problems import Problem


def is_of_the_disk(problems: Iterable[Problem]) -> bool:
    """Tell whether nothing but the disk refused: nothing is wrong with frames and parameters."""
    codes = {problem.code for problem in problems}
    return bool(codes) and codes <= DISK_CODES


class Standing:
    """Remembers the products of stages as they were before this build."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._stood: dict[Key, dict[str, str]] = {}

    def note(self, keys: Iterable[Key]) -> None:
        """Look at some stages, before any of them is done anew."""
        for key in keys:
            self._stood.setdefault(key, self._ledger.products(key))

    def holds(self, keys: Iterable[Key]) -> bool:
        """Tell whether all that these stages made stands undamaged, and is what it was.

        A layer that is older than the registration or the reference beside it would be false.
        """
        return all(
            self._stood.get(key)
            and self._stood[key] == self._ledger.products(key)
            and not self._ledger.damaged(key)
            for key in dict.fromkeys(keys)
        )
