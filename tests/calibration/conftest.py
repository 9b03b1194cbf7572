"""A sensor of which everything is known."""

from dataclasses import dataclass

import numpy as np
import pytest


@dataclass(frozen=True)
class KnownSensor:
    """Counts per electron, read noise and black in counts; `white` in electrons."""

    gain: float = 0.1
    read: float = 2.0
    black: float = 64.0
    prnu: float = 0.019
    white: float = 30_000.0
    saturation: int = 4095

    def shots(self, electrons, count, rng, *, black=None):
        """Return raw frames (uint16) of a scene in electrons; the PRNU is the same in each."""
        shape = np.shape(electrons)
        response = 1 + self.prnu * np.random.default_rng(99).standard_normal(shape)
        offset = self.black if black is None else black
        lit = (rng.poisson(electrons * response) * self.gain for _ in range(count))
        raw = (np.rint(light + rng.normal(offset, self.read, shape)) for light in lit)
        return [np.clip(frame, 0, self.saturation).astype(np.uint16) for frame in raw]


@pytest.fixture
def sensor():
    return KnownSensor()
