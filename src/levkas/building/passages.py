"""All lines of a large scan, calibrated once: what is told of them, and the pictures of their bands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.denoising import describe_removed
from levkas.calibration.templates import CalibrationRefused, describe_lost, gaps_of, no_values
from levkas.core.cube import UNRELIABLE
from levkas.registration.bands import BandImage

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.building.scans import Scan
    from levkas.core.cube import Cube


class Passage:
    """All lines of a scan, calibrated once, and what is to be told of them.

    To be iterated over once; `Scan.told` has the warnings then.
    """

    def __init__(self, scan: Scan) -> None:
        from levkas.calibration.denoising import Projecting

        self._scan = scan
        self._lost = np.zeros(scan.shape[2], np.int64)
        self._projecting = Projecting(scan.subspace) if scan.subspace else None

    def __iter__(self) -> Iterator[Cube]:
        """Yield some lines at a time.

        Raises CalibrationRefused where a band has no finite value at all.
        """
        for raw in self._scan.raw_blocks():
            whole = raw.codes.dtype.kind in "ui"
            lost = np.zeros((1, 1, 1), bool) if whole else ~np.isfinite(raw.codes)
            if (templates := gaps_of(*raw.darks, raw.white)) is not None:
                lost = lost | templates
            if lost.any():
                self._lost += np.broadcast_to(lost, raw.codes.shape).sum((0, 1))
            yield self._scan.calibrated(raw, self._projecting)
        self._tell()

    def _tell(self) -> None:
        from levkas.calibration.sensor_context import placed

        bench, shape = self._scan.bench, self._scan.shape
        every = shape[0] * shape[1]
        if (empty := np.flatnonzero(self._lost == every)).size:
            refused = no_values(int(empty[0]), shape)
            raise CalibrationRefused(*(placed(p, bench.sensor.object) for p in refused.problems))
        notes = []
        if count := int(self._lost.sum()):
            notes.append(describe_lost(count, every * shape[2], bench.camera.name))
        if (made := self._projecting) is not None:
            notes.append(describe_removed(made.subspace, made.removed, made.most))
        self._scan.told[:] = [f"{self._scan.where}: {note}" for note in notes]


class Reducer:
    """Gathers the pictures of a scan while its lines pass by."""

    def __init__(self, scan: Scan) -> None:
        self._scan, self._factor = scan, scan.factor
        lines, samples, bands = scan.shape
        height, width = lines // self._factor, samples // self._factor
        self._sums = np.zeros((bands, height, width), np.float32)
        self._counts = np.zeros((bands, height, width), np.uint16)
        self._row: tuple[np.ndarray, np.ndarray] | None = None
        self._line = 0

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        factor, width = self._factor, self._sums.shape[2]
        shape = (width, factor, cube.values.shape[2])
        for values, flags in zip(cube.values, cube.flags, strict=True):
            row = self._line // factor
            self._line += 1
            if row >= self._sums.shape[1]:
                return
            good = (flags[: width * factor] & UNRELIABLE) == 0
            seen = np.where(good, values[: width * factor], np.float32(0)).reshape(shape)
            # Line by line and sample by sample: the sums do not depend on how lines come in.
            for k in range(factor):
                self._sums[:, row] += seen[:, k].T
            self._counts[:, row] += good.reshape(shape).sum(1, dtype=np.uint16).T

    def images(self) -> list[BandImage]:
        """Return the pictures."""
        least = self._factor**2 / 2
        return [
            BandImage(
                band.label,
                band.wavelength,
                (sums / np.maximum(counts, 1)).astype(np.float32),
                counts >= least,
            )
            for band, sums, counts in zip(self._scan.bands, self._sums, self._counts, strict=True)
        ]
