"""White target: its reflectance over a frame, and the checks of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from levkas.calibration.findings import CalibrationRefused, Finding, refusal
from levkas.calibration.patterns import channel_names, channel_table
from levkas.calibration.templates import Template

LIT, GAUSSIAN = 0.7, 5.0
"""Share of a channel above the dark that light makes at least: noise alone makes a half, and paint of half the noise 0.69. 99th
percentile over the median of noise without a sign is 3.8: a lit part of 1 % has more."""
MOST, SAMPLE, BEYOND, SHOWN = 0.5, 100_000, 1.05, 6
"""Share of a channel's white that must be usable; pixels looked at; highest over lowest code of saturated sensels from which they are
not clipped at one code; channels that a message names."""


@dataclass(frozen=True, eq=False)
class WhiteBoard:
    """The white board of a capture: its reflectance > 0, one number or one for each band (each channel of a mosaic's `pattern`).

    `checked` is whether the whole frames were checked before: some of their lines are not refused. `unit` is of files of reflectance,
    which have no white: the value of reflectance 1.0, one for all bands or for each.
    """

    reflectance: float | Sequence[float] | np.ndarray = 1.0
    pattern: str | Sequence[Sequence[str]] | None = None
    labels: Sequence[str] | None = None
    checked: bool = False
    unit: Sequence[float] | np.ndarray | None = None

    def of_bands(self, bands: np.ndarray, shape: tuple[int, ...]) -> WhiteBoard:
        """Return the board in some of the bands, indices into `shape` (bands,)."""
        known = np.broadcast_to(np.asarray(self.reflectance, float), shape)
        labels = [self.labels[band] for band in bands] if self.labels else None
        unit = None if self.unit is None else np.broadcast_to(self.unit, shape)[bands]
        return replace(self, reflectance=known[bands], pattern=None, labels=labels, unit=unit)


PERFECT = WhiteBoard()
"""A perfect diffuser."""


def reflectance_table(board: WhiteBoard, shot: Template) -> np.ndarray:
    """Lay the white's reflectance out as it repeats over the (h, w·b) view of a frame.

    The table is (1, b) or of the pattern's shape: channels in the order of the board's labels, else as the pattern first shows them.
    Raises CalibrationRefused, E_VALUE where the numbers do not fit.
    """
    known = np.atleast_1d(np.asarray(board.reflectance, float))
    if board.pattern is not None:
        places = channel_table(board.pattern, board.labels)
    else:
        places = np.arange(1 if shot.mean.ndim == 2 else shot.mean.shape[2])[None]
    wanted = int(places.max()) + 1
    if known.size not in (1, wanted) or not np.all(np.isfinite(known) & (known > 0)):
        found = f"{known.size} numbers, {np.nanmin(known):g} to {np.nanmax(known):g}"
        raise refusal("board_differs", found, limit=wanted)
    return np.ascontiguousarray(np.broadcast_to(known.ravel(), wanted)[places])


def check_white(
    white: Template,
    level: np.ndarray,
    pattern: str | Sequence[Sequence[str]] | None,
    labels: Sequence[str] | None,
) -> None:
    """Refuse a white that is darker than dark, or saturated, over more than half of a channel, or has no light but noise.

    `level` is the white's dark, counts; it broadcasts to the white.

    Raises CalibrationRefused, E_WHITE_DARK, E_WHITE_SATURATED; one problem each, which names the channels by `labels`.
    """
    level = np.broadcast_to(level, white.mean.shape)
    channels = _channels(white, pattern, labels)
    dark, saturated = {}, {}
    for name, part in channels:
        lit, under, clipped = white.mean[part], level[part], white.saturated[part]
        if np.mean(lit > under) < MOST or _is_unlit(lit - under):
            dark[name] = lit, under
        elif np.mean(clipped) > MOST:
            saturated[name] = lit, clipped
    findings = []
    if dark:
        lit, under = next(iter(dark.values()))
        level_lit, level_under = float(np.median(lit)), float(np.median(under))
        swapped = len(dark) == len(channels) and level_under > 2 * level_lit
        code = "white_swapped" if swapped else "white_dark"
        findings.append(Finding(code, _named([*dark], len(channels)), level_lit, level_under))
    if saturated:
        lit, clipped = next(iter(saturated.values()))
        lowest, highest = np.percentile(lit[clipped], (1, 99))
        # What is clipped has one code.
        code = "white_beyond" if highest > BEYOND * lowest else "white_saturated"
        share, named = float(np.mean(clipped)), _named(list(saturated), len(channels))
        findings.append(Finding(code, named, share, MOST))
    if findings:
        raise CalibrationRefused(*(one.problem() for one in findings))


def thinning(size: tuple[int, ...]) -> int:
    """Return which so-many-th pixel a side of a white of (height, width) is looked at.

    >>> thinning((1000, 2000))
    4
    """
    return max(1, int(np.sqrt(size[0] * size[1] / SAMPLE)))


def _is_unlit(light: np.ndarray) -> bool:
    """Return whether counts above dark are noise about zero.

    >>> rng = np.random.default_rng(1)
    >>> _is_unlit(rng.normal(0, 2, 10_000)), _is_unlit(rng.normal(2, 2, 10_000))
    (True, False)
    """
    apart = np.abs(light)
    above = float(np.mean(light > 0) + np.mean(light == 0) / 2)
    return 1 - LIT < above < LIT and bool(np.quantile(apart, 0.99) <= GAUSSIAN * np.median(apart))


def _named(names: Sequence[str], channels: int) -> str:
    """Return in which channels; empty where there is one without a name.

    >>> _named(["R", "G", "B"], 3), _named(["450 nm"], 3), _named([""], 1)
    (' in all 3 channels', ' in 450 nm', '')
    """
    if len(names) == channels > 1:
        return f" in all {channels} channels"
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f" in {', '.join(names[:SHOWN])}{more}" if any(names) else ""


def _channels(
    white: Template, pattern: str | Sequence[Sequence[str]] | None, labels: Sequence[str] | None
) -> list[tuple[str, tuple]]:
    """Return (how to name it, index) of each channel, thinned to about `SAMPLE` pixels."""
    step = thinning(white.mean.shape[:2])
    thin = np.s_[::step, ::step]
    if white.mean.ndim == 3:
        names = labels or [str(band) for band in range(white.mean.shape[2])]
        return [(name, (*thin, band)) for band, name in enumerate(names)]
    if pattern is None:
        return [(labels[0] if labels else "", thin)]
    table, names = channel_table(pattern), channel_names(pattern)
    rows, columns = (-(-step // size) * size for size in table.shape)
    places = {name: np.argwhere(table == i)[0] for i, name in enumerate(names)}
    return [(name, np.s_[y::rows, x::columns]) for name, (y, x) in places.items()]
