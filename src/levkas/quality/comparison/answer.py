"""What a compared method answers: a map between the two pictures of a pair, or nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

Decision = Literal["accept", "warn", "refuse", "none"]


class NoAnswer(Exception):
    """The method gives no map for this pair; the text says why."""


@dataclass(frozen=True)
class Answer:
    """A map and what its method says of it.

    Parameters
    ----------
    found : callable
        (n, 2) px of the pair's reference → px of its target.
    note : str
        Matches kept, final cost, and the like.
    decision : {"accept", "warn", "refuse", "none"}
        ``"none"``: the method has no opinion of its own result.
    """

    found: Callable[[np.ndarray], np.ndarray]
    note: str = ""
    decision: Decision = "none"
