"""Characterisation of cameras after EMVA 1288: facts of frames, photon transfer, linearity, steadiness of the light."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from levkas.quality.emva1288.report import Examination


def examine_with_seed(
    path: str | Path, *, cameras: Sequence[str] | None = None, seed: int = 1
) -> Examination:
    """Do as `examining.examine` does, with a generator of random numbers made from a seed."""
    import numpy as np

    from levkas.quality.emva1288.examine import examine

    return examine(path, cameras=cameras, rng=np.random.default_rng(seed))
