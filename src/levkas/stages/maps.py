"""Maps of one scan (elements, spectra) as a program computed them: nothing to calibrate."""

from __future__ import annotations

import numpy as np

from levkas.calibration.sensor import SensorCapture, SensorCube, read_cube
from levkas.core.flags import Flag
from levkas.core.problems import Problem
from levkas.readers.facts import UnreadableCapture
from levkas.readers.frames import read_plane
from levkas.stages.calibrate import require_one_size
from levkas.stages.exposures import cube_of

MOST_MAPS = 200
"""Of one stack; programs for X-ray fluorescence fit some twenty elements, and a stack of more holds spectra."""


def develop_maps(context: SensorCapture) -> SensorCube:
    """A stack of maps, in one file or a file each, its values as they are; what is not finite is outside of the scan.

    Raises UnreadableCapture where the stack holds spectra, not maps, and CalibrationRefused where files differ in size.
    """
    frame = context.sensor.object[0]
    count = len(context.sensor.bands)
    if count > MOST_MAPS:
        raise UnreadableCapture(
            Problem(
                "E_BAND_COUNT",
                f"{context.camera.name}: the stack holds spectra, not maps",
                str(frame.path),
                f"cameras.{context.camera.name}.kind",
                f"{count} pictures",
                f"at most {MOST_MAPS} maps",
                "Fit the elements first, with PyMca for instance, and name their maps.",
            )
        )
    if frame.band is None:
        values = np.ascontiguousarray(read_cube(frame), np.float32)
    else:
        require_one_size(context)
        planes = [read_plane(one.path, page=one.page) for one in context.sensor.object]
        values = np.stack([np.asarray(plane, np.float32) for plane in planes], -1)
    outside = ~np.isfinite(values)
    flags = np.where(outside, np.uint8(Flag.OUTSIDE), np.uint8(0))
    values = np.where(outside, np.float32(np.nan), values)
    return SensorCube(cube_of(context, values, flags, None, "counts"))
