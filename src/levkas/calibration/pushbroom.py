"""Line scanners: templates averaged along the scan.

A push-broom camera has one line of sensels: its dark and white are that line, seen many times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from levkas.calibration.templates import Template, average


def average_lines(
    blocks: Iterable[np.ndarray],
    *,
    saturation: float | None = None,
    black_clip: float | None = 0.0,
    exposure_s: float | None = None,
) -> Template:
    """Average a push-broom dark or white along the scan.

    Parameters
    ----------
    blocks : iterable of ndarray, (lines, samples, bands)
        Consecutive lines, in blocks of any height; one block at a time is held.
    saturation, black_clip, exposure_s
        As in `templates.average`.

    Returns
    -------
    template : Template, (1, samples, bands)
        `count` is the number of lines, `variance` that of one line over the scan.

    Examples
    --------
    >>> t = average_lines([np.array([[[1], [5]], [[3], [7]]], np.uint16)])
    >>> t.mean.tolist(), t.count
    ([[[2.0], [6.0]]], 2)
    """
    lines: Iterator[np.ndarray] = (line[None] for block in blocks for line in block)
    return average(lines, saturation=saturation, black_clip=black_clip, exposure_s=exposure_s)
