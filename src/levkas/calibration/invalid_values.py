"""Values that are no numbers: NaN and infinities of float frames, kept from their neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.problems import Problem


def close_gaps(template: Template) -> Template:
    """Return a template without NaN and infinities, and with `lost` where they were.

    The median of the band stands there meanwhile, so that no statistic and no neighbour is poisoned;
    whoever uses the values has to flag `lost`.

    Parameters
    ----------
    template : Template, (h, w) or (h, w, b)
        A value that is not finite in any of its shots is not finite in its mean.

    Raises
    ------
    CalibrationRefused
        E_VALUE where a band has no finite value at all.

    Examples
    --------
    >>> from levkas.calibration.templates import average
    >>> closed = close_gaps(average([np.array([[1.0, np.nan, 3.0]])]))
    >>> closed.mean.tolist(), closed.lost.tolist()
    ([[1.0, 2.0, 3.0]], [[False, True, False]])
    """
    arrays = [a for a in (template.mean, template.variance) if a is not None]
    if all(np.isfinite(np.sum(a, dtype=np.float64)) for a in arrays):
        return template  # a sum takes no memory, and is finite only where all are
    lost = ~np.isfinite(template.mean)
    if template.variance is not None:
        lost |= ~np.isfinite(template.variance)
    mean = _filled(template.mean, lost)
    variance = None if template.variance is None else _filled(template.variance, lost)
    return replace(
        template,
        mean=mean,
        variance=variance,
        saturated=template.saturated & ~lost,
        black=template.black & ~lost,
        lost=lost,
    )


def gaps_of(*templates: Template | None) -> np.ndarray | None:
    """Return where any of some templates lost its value; None where none did.

    Shapes broadcast: a template one line high holds for every line.
    """
    lost: np.ndarray | None = None
    for template in templates:
        if template is not None and template.lost is not None:
            lost = template.lost if lost is None else lost | template.lost
    return lost


def describe_gaps(lost: np.ndarray, label: str = "") -> str:
    """Say how many values were lost.

    >>> describe_gaps(np.array([True, False, False, False]), "550 nm")
    '550 nm: 1 value (25 %) is no finite number in a frame: flagged as defect'
    """
    return describe_lost(int(np.count_nonzero(lost)), lost.size, label)


def describe_lost(count: int, total: int, label: str = "") -> str:
    """Say that `count` values of `total` were lost."""
    many = "values" if count > 1 else "value"
    verb, what = ("are", "defects") if count > 1 else ("is", "defect")
    share = 100 * count / total
    start = f"{label}: " if label else ""
    return f"{start}{count} {many} ({share:.2g} %) {verb} no finite number in a frame: flagged as {what}"


def _filled(values: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Return a copy with the median of each band where values are lost."""
    filled = values.copy()
    planes = filled[..., None] if filled.ndim == 2 else filled
    marks = lost[..., None] if lost.ndim == 2 else lost
    for band in range(planes.shape[2]):
        plane, gone = planes[..., band], marks[..., band]
        if gone.all():
            raise no_values(band, planes.shape)
        plane[gone] = np.median(plane[~gone])
    return filled


def no_values(band: int, shape: tuple[int, ...]) -> CalibrationRefused:
    """Return the refusal of a band, of frames (height, width, bands), without a finite value."""
    several = shape[2] > 1
    return CalibrationRefused(
        Problem(
            "E_VALUE",
            f"band {band + 1} of the frames has no finite value"
            if several
            else "no value is finite",
            field="pixels",
            found=f"{shape[1]} x {shape[0]} values, each NaN or infinite in some frame",
            expected="finite numbers",
            fix="Export the frame again, or leave it out of `files`.",
        )
    )
