"""Infer darks and whites, mosaics and the colour of objects from a few decoded frames."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import numpy as np

from levkas.campaign.guess.groups import CameraGroup
from levkas.campaign.guess.names import NamedFile
from levkas.campaign.guess.pixels import (
    MOST_SAMPLED,
    GuessedMosaic,
    Samples,
    Statistics,
    find_mosaic,
    name_mosaic,
    spread,
)

CLIPPED = 20
"""Samples at a frame's highest code from which on it shows a mosaic less well than one without."""
DARK_SHARE = 0.08
"""A dark's 99th percentile is below this share of the brightest level that any target reaches."""
EVEN_DARK = 0.04
"""Share of the brightest level that the percentiles 1 and 99 of a dark may be apart."""
MOST_TARGETS = 200
"""Targets of a camera, spread over all, of which a frame is decoded; more would take minutes."""
STRUCTURED = 3.0
"""The others must have this many times a white's texture."""


# --- darks and whites -------------------------------------------------------------------------


def infer_roles(group: CameraGroup, samples: Samples) -> list[str]:
    """Give targets of a camera the roles that their frames show, where no name has them.

    Parameters
    ----------
    group : CameraGroup
        Its frames are replaced.
    samples : Samples

    Returns
    -------
    reasons : list of str
        Of each guess.
    """
    frames = group.of_role("object")
    plain = all(f.file.channels == 1 or f.facts.is_cube for f in frames)
    by_target = group.by_target(frames)
    named = {f.role for f in group.of_role("dark", "white")}
    if len(named) == 2 or not plain or len(by_target) < 2:
        return []
    found: dict[str, Statistics] = {}
    for target in spread(list(by_target), MOST_TARGETS):
        if statistics := samples.of_some(_like(by_target[target], frames[0]), 1):
            found[target] = statistics[0]
    white = samples.of_some(_like(group.of_role("white"), frames[0]), 1)
    roles, reasons = _roles_of(found, white[0] if white else None, named)
    group.frames = [f.with_role(roles.get(f.target, f.role)) for f in group.frames]
    if len(by_target) > MOST_TARGETS:
        reasons.append(
            f"whether darks or whites are among {len(by_target) - MOST_TARGETS} of "
            f"{len(by_target)} targets: their names do not show it, and their frames were not read"
        )
    return reasons


def _like(frames: Sequence[NamedFile], first: NamedFile) -> Sequence[NamedFile]:
    """Return the frames of the sensor and wavelength of another; all where there is none."""
    nm = first.number("wavelength")
    return [f for f in frames if (f.sensor, f.number("wavelength")) == (first.sensor, nm)] or frames


def _roles_of(
    found: Mapping[str, Statistics], white: Statistics | None, named: Container[str]
) -> tuple[dict[str, str], list[str]]:
    """Return the darks and whites among targets by their statistics, and the reasons.

    Roles that are `named` are not looked for. A dark must be even: a painting may be dark all over; and without a dark
    nothing is taken for a white: it may be a bright page.
    """
    every = [*found.values(), *([white] if white else [])]
    brightest = max((s.high for s in every), default=0.0)
    darks = {
        t: s
        for t, s in ({} if "dark" in named else found).items()
        if s.high < DARK_SHARE * brightest and s.high - s.low < EVEN_DARK * brightest
    }
    reasons = [
        f"{t} is assumed to be a dark: 99 % of its pixels are below {s.high:.4g} counts"
        for t, s in darks.items()
    ]
    rest = {t: s for t, s in found.items() if t not in darks}
    whites = []
    for target, s in rest.items() if "white" not in named and ("dark" in named or darks) else ():
        others = [o.texture for t, o in rest.items() if t != target]
        even = s.is_even and s.mean > 0.3 * brightest
        if even and others and max(others) > STRUCTURED * max(s.texture, 1e-6):
            whites.append(target)
            reasons.append(
                f"{target} is assumed to be a white: bright ({s.mean:.4g} counts) and uniform"
            )
    if len(darks) + len(whites) == len(found):
        return {}, []  # nothing would be left to be an object
    return dict.fromkeys(darks, "dark") | dict.fromkeys(whites, "white"), reasons


# --- mosaics ----------------------------------------------------------------------------------


def _bright_and_dark(
    frames: Sequence[NamedFile], samples: Samples
) -> tuple[Statistics | None, float]:
    """Return a bright frame, a white or else an object, and the level without light."""
    dark = samples.of_some([f for f in frames if f.role == "dark"], 1)
    for role in ("white", "object", "chart"):
        found = samples.of_some([f for f in frames if f.role == role], 3)
        usable = [s for s in found if s.high < 0.98 * s.top or s.top_count < CLIPPED] or found
        if usable:
            return max(usable, key=lambda s: s.mean), dark[0].mean if dark else 0.0
    return None, 0.0


def tile_side(frames: Sequence[NamedFile], samples: Samples) -> int:
    """Return the side of the mosaic's tile; 0 where no mosaic is found."""
    bright, dark = _bright_and_dark(frames, samples)
    return find_mosaic(bright.phases, dark=dark) if bright is not None else 0


def mosaic_of(frames: Sequence[NamedFile], samples: Samples) -> GuessedMosaic | None:
    """Return the mosaic that frames of one sensor show, its channels named; None for none."""
    bright, dark = _bright_and_dark(frames, samples)
    if bright is None or not (side := find_mosaic(bright.phases, dark=dark)):
        return None
    shown: dict[str, np.ndarray] = {}
    if any(f.role == "white" for f in frames):
        for frame in (f for f in frames if f.role == "object"):
            if frame.target not in shown and len(shown) < MOST_SAMPLED:
                statistics = samples.of(frame.file)
                shown |= {frame.target: statistics.phases[side]} if statistics else {}
    return name_mosaic(side, bright.phases[side], dark=dark, shown=shown)
