"""Design of a filter that evens a camera's channels out, as a linear program.

A filter only takes light away, so that of the exposure *time* is part of the program: with u = t·T(λ)
the electrons of a channel are linear in u, and so are the limits 0 ≤ T ≤ 1 (0 ≤ u ≤ t) and s of the
slope of T. The smallest channel is maximised while the largest stays at full exposure. (With the time
left out, no filter at all would always win.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linprog

from levkas.planning.exposure_plan import electron_rates, irradiance_spectrum
from levkas.planning.spectra import GRID
from levkas.planning.tables import PlanRefused, wrong

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioSetup


@dataclass(frozen=True, eq=False)
class RegulatingFilter:
    """A transmittance over wavelength, and what the channels get by it.

    Parameters
    ----------
    wavelengths, transmittance : ndarray, (n,)
    channels : tuple of str
    before, after : ndarray, (channels,)
        Exposure over the fullest channel's.
    time_factor : float
        How many times longer the exposure is.
    """

    wavelengths: np.ndarray
    transmittance: np.ndarray
    channels: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    time_factor: float


def solve_filter(
    weights: np.ndarray, step_nm: float, *, steepest: float, longest: float
) -> tuple[np.ndarray, float]:
    """Solve the linear program.

    Parameters
    ----------
    weights : ndarray, (channels, n)
        Light times sensitivity at even wavelengths, scaled so that the largest row sum is 1.
    step_nm : float
    steepest : float
        Largest |dT/dλ|, 1/nm.
    longest : float
        Largest exposure time over that without a filter.

    Returns
    -------
    transmittance : ndarray, (n,)
    time : float
        Exposure time over that without a filter.

    Examples
    --------
    Two channels apart, one with four times the light: the filter takes three quarters of it.

    >>> weights = np.zeros((2, 40)); weights[0, :10] = 0.1; weights[1, 30:] = 0.025
    >>> t, time = solve_filter(weights, 10.0, steepest=0.01, longest=8.0)
    >>> round(float(t[:10].mean()), 2), round(float(t[30:].mean()), 2), round(time, 2)
    (0.25, 1.0, 4.0)
    """
    n = weights.shape[1]

    # Unknowns: u (n), time, smallest and fullest channel.
    def rows(of_u: np.ndarray, *of_others: float) -> np.ndarray:
        return np.hstack([of_u, np.tile(of_others, (len(of_u), 1))])

    one, none, steep = np.eye(n), np.zeros((1, n)), steepest * step_nm
    difference = np.diff(one, axis=0)
    table = np.vstack(
        [
            rows(one, -1, 0, 0),  # u <= time
            rows(difference, -steep, 0, 0),
            rows(-difference, -steep, 0, 0),
            rows(-one, 0, 0, 0),  # u >= 0
            rows(-weights, 0, 1, 0),
            rows(weights, 0, 0, -1),
            rows(none, 0, 0, 1),  # the fullest: 1 at most
            rows(none, 1, 0, 0),  # the longest time
        ]
    )
    bound = np.concatenate([np.zeros(len(table) - 2), [1, longest]])
    # Traces of weight take, of equally good filters, the most even one and then the shortest exposure.
    goal = np.concatenate([np.zeros(n), [1e-6, -1, 1e-3]])
    found = linprog(goal, table, bound, bounds=(None, None), method="highs").x
    time = float(found[n])
    return np.clip(found[:n] / max(time, 1e-12), 0, 1), time


def regulating_filter(
    setup: StudioSetup, camera: str, name: str | None = None, *, step_nm: float = 10.0,
    steepest: float = 0.01, longest: float = 8.0,
) -> RegulatingFilter:  # fmt: skip
    """Return the filter that evens a camera's channels out under a lighting.

    Parameters
    ----------
    setup : StudioSetup
    camera : str
    name : str, optional
        Of the lighting.
    step_nm : float
    steepest : float
        Largest slope of the transmittance, 1/nm; glass and dyes reach about 0.01.
    longest : float
        Largest exposure time over that without the filter.

    Raises
    ------
    PlanRefused
        Where there is no such camera, or light of unknown strength.
    """
    if camera not in setup.cameras:
        raise PlanRefused(
            wrong(str(setup.path), "cameras", "there is no such camera", camera,
                  ", ".join(setup.cameras))
        )  # fmt: skip
    lighting: Lighting = setup.lighting(name)
    seen = setup.cameras[camera]
    spectrum = irradiance_spectrum(setup, lighting)
    grid = np.arange(np.floor(seen.seen[0] / step_nm) * step_nm, seen.seen[1] + step_nm, step_nm)
    weights = np.stack(
        [
            electron_rates(setup, seen, lighting, spectrum * _tent(w, step_nm))
            for w in grid
        ],
        1,
    )  # fmt: skip
    weights = weights / weights.sum(1).max()
    transmittance, time = solve_filter(weights, step_nm, steepest=steepest, longest=longest)
    before = weights.sum(1)
    after = time * weights @ transmittance
    return RegulatingFilter(
        grid, transmittance, seen.labels, before / before.max(), after / after.max(), time
    )


def _tent(centre: float, step: float) -> np.ndarray:
    """Linear interpolation between even wavelengths, as weights at `spectra.GRID`."""
    return np.maximum(1 - np.abs(GRID - centre) / step, 0)
