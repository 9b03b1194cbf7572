"""A captured white as a plan sees it: averaged, above dark, thinned to the light alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from levkas.calibration.templates import Template, average
from levkas.core.problems import Problem, Refused
from levkas.planning.full_scale import find_full_scale, not_known
from levkas.quality.emva1288.facts import frames_below
from levkas.readers.frames import read_facts, read_frame

TOLERATED = 1e-3  # share of pixels at saturation: glints and hot sensels
CELLS = 24  # columns to which a white is thinned: light has no detail, dust and noise have
PERIODS = (60, 12, 1)  # of mosaics, common multiples: blocks then hold all channels alike

Box = tuple[int, int, int, int]


class WhiteRefused(Refused):
    """A white that cannot tell where the lamps stand."""


def files_of(paths: Sequence[str | Path]) -> list[Path]:
    """Return files, and the frames of folders."""
    found = []
    for path in map(Path, paths):
        found += frames_below(path) if path.is_dir() else [path]
    return found


def average_whites(
    files: list[Path],
    darks: list[Path],
    black: float | None,
    saturation: float | None,
    bits: int | None = None,
) -> tuple[Template, np.ndarray | float]:
    """Average whites; return them and what is to be subtracted.

    Raises WhiteRefused, ``E_BITS`` where nothing tells at which code they would clip.
    """
    if not files:
        raise WhiteRefused(
            Problem(
                "E_NO_FRAMES", "there is no white", expected="one frame or more, or their folder"
            )
        )
    facts = read_facts(files[0])
    scale = find_full_scale(files, facts, bits=bits, saturation=saturation)
    if scale is None and np.dtype(facts.dtype).kind in "ui":
        raise WhiteRefused(not_known(files[0], facts))
    full = scale.counts if scale else None
    stack = average((read_frame(f) for f in files), saturation=full)
    if not darks:
        told = (black, scale.black if scale else None, facts.black)
        return stack, next((level for level in told if level is not None), 0.0)
    dark = average([read_frame(f) for f in darks])
    if dark.mean.shape != stack.mean.shape:
        raise WhiteRefused(
            Problem(
                "E_SIZE", "the dark has another size than the white", str(darks[0]),
                found=str(dark.mean.shape), expected=str(stack.mean.shape),
                fix="Take both with the same camera and settings.",
            )
        )  # fmt: skip
    return stack, dark.mean


def check_region(region: Box | None, shape: tuple[int, ...], file: str) -> Box:
    """Return x, y, width, height; of the whole frame without a region."""
    rows, columns = shape[:2]
    if region is None:
        return 0, 0, columns, rows
    x, y, width, height = region
    if min(x, y) < 0 or min(width, height) < 8 or x + width > columns or y + height > rows:
        raise WhiteRefused(
            Problem("E_REGION", "the region does not lie in the frame", file, "region", str(region),
                    f"within {columns} x {rows} pixels, 8 or more each way",
                    "Give x,y,width,height in native pixels.")
        )  # fmt: skip
    return region


def thin_white(stack: Template, floor: np.ndarray | float, box: Box, file: str) -> np.ndarray:
    """Return the light on a coarse grid: medians of blocks, which dust and hot sensels do not move."""
    x, y, width, height = box
    cut = np.s_[y : y + height, x : x + width]
    clipped = float(np.mean(stack.saturated[cut]))
    if clipped > TOLERATED:
        raise WhiteRefused(
            Problem("E_WHITE_SATURATED", "the white clips, so that its shape is lost", file,
                    found=f"{clipped:.1%} of its values at saturation", expected=f"{TOLERATED:.1%} at most",
                    fix="Expose for less, or give the right --saturation.")
        )  # fmt: skip
    values = (stack.mean - floor)[cut].astype(np.float64)
    light = _thinned(values.reshape(height, width, -1))
    if light.min() <= 0:
        raise WhiteRefused(
            Problem("E_WHITE_DARK", "parts of the white do not stand above black", file,
                    found=f"{light.min():.1f} counts above it", expected="more than 0",
                    fix="Give the board's place as --region, and the camera's own darks.")
        )  # fmt: skip
    return light


def _thinned(values: np.ndarray) -> np.ndarray:
    """Return medians of blocks, (rows, columns), of a frame (h, w, samples).

    Each phase of a mosaic and each channel is scaled to one mean first: among unlike values a median
    would jump from one to the other.
    """
    height, width, samples = values.shape
    period = next(p for p in PERIODS if p == 1 or min(width, height) >= 12 * p)
    rows, columns = height // period, width // period
    cells = values[: rows * period, : columns * period]
    cells = cells.reshape(rows, period, columns, period, samples)
    gain = cells.mean((0, 2))
    level = max(float(gain.mean()), 1e-12)
    cells = cells * np.divide(level, gain, out=np.ones_like(gain), where=gain > 0)[:, None]
    block = max(1, -(-columns // CELLS))
    rows, columns = rows // block * block, columns // block * block
    cells = cells[:rows, :, :columns].reshape(
        rows // block, block * period, columns // block, block * period * samples
    )
    return np.median(cells, axis=(1, 3))
