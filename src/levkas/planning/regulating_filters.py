"""Regulating filter: a transmittance that evens a camera's channels out, from the model or from a captured white.

A filter that evens a camera's channels out only takes light away, so its design has the exposure *time*
among the unknowns: with u = t·T(λ) the electrons of a channel are linear in u, and so are the limits
0 ≤ T ≤ 1 (0 ≤ u ≤ t) and s of the slope of T. The smallest channel is maximised while the largest stays
at full exposure. (With the time left out, no filter at all would always win.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import unknown_name
from levkas.planning.exposure_plan import electron_rates, irradiance_spectrum
from levkas.planning.spectra import GRID
from levkas.planning.tables import PlanRefused, value_problem

if TYPE_CHECKING:
    from collections.abc import Mapping

    from levkas.planning.setup import Lighting, StudioCamera, StudioSetup


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
    factors : ndarray, (channels,), optional
        What a captured white shows of each channel over what sensitivities and light say, geometric mean 1.
    modelled : ndarray, (n,), optional
        Transmittance of the filter without that white.
    model_alone : float, optional
        Smallest over fullest channel of the camera as it is, behind that one.
    notes : tuple of str
    """

    wavelengths: np.ndarray
    transmittance: np.ndarray
    channels: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    time_factor: float
    factors: np.ndarray | None = None
    modelled: np.ndarray | None = None
    model_alone: float | None = None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        record: dict[str, Any] = {
            "wavelengths": self.wavelengths.tolist(),
            "transmittance": self.transmittance.round(4).tolist(),
            "smallest_before": float(self.before.min()),
            "smallest_after": float(self.after.min()),
            "time_factor": self.time_factor,
            "channels": {
                name: {"before": float(a), "after": float(b)}
                for name, a, b in zip(self.channels, self.before, self.after, strict=True)
            },
        }
        if self.factors is not None:
            factors = zip(self.channels, self.factors.round(4).tolist(), strict=True)
            record["measured"] = {
                "factors": dict(factors),
                "smallest_with_modelled_filter": self.model_alone,
                "notes": list(self.notes),
            }
        return record


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
    from scipy.optimize import linprog

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


STEP_NM = 10.0
STEEPEST = 0.01
"""Largest slope of a filter's transmittance, 1/nm: glass and dyes reach about that."""
LONGEST = 8.0
"""Largest exposure time over that without the filter."""


def check_filtered(setup: StudioSetup, camera: str) -> None:
    """Refuse a camera that no filter can even out: unknown, of one channel, or with a time a band.

    Raises
    ------
    PlanRefused
    """
    several = [
        name
        for name, one in setup.cameras.items()
        if one.keys.exposure == "one" and len(one.labels) > 1
    ]
    if camera not in several:
        what, file = "this camera has no channels to even out by a filter", str(setup.path)
        known = several or ['a camera of several channels with exposure = "one"']
        raise PlanRefused(unknown_name(what, camera, known, file=file, field="cameras"))


FAR_OFF = 2.0
"""Factor between what a channel records and what it should, which deserves a word."""


def regulating_filter(
    setup: StudioSetup,
    camera: str,
    name: str | None = None,
    *,
    levels: Mapping[str, float] | None = None,
) -> RegulatingFilter:
    """Return the filter that evens a camera's channels out under a lighting.

    Parameters
    ----------
    setup : StudioSetup
    camera : str
    name : str, optional
        Of the lighting.
    levels : mapping of str to float, optional
        Signal of each channel on a captured white under that lighting, above black, at equal times: what
        the model says of a channel is scaled to it.

    Raises
    ------
    PlanRefused
        Where there is no such camera, light of unknown strength, or a channel without a level.
    """
    if camera not in setup.cameras:
        raise PlanRefused(
            value_problem(str(setup.path), "cameras", "there is no such camera", camera,
                  ", ".join(setup.cameras))
        )  # fmt: skip
    lighting: Lighting = setup.lighting(name)
    studio = setup.cameras[camera]
    spectrum = irradiance_spectrum(setup, lighting)
    grid = np.arange(
        np.floor(studio.range_nm[0] / STEP_NM) * STEP_NM, studio.range_nm[1] + STEP_NM, STEP_NM
    )
    weights = np.stack(
        [
            electron_rates(setup, studio, lighting, spectrum * _tent(w, STEP_NM))
            for w in grid
        ],
        1,
    )  # fmt: skip
    factors = None if levels is None else _factors(setup, studio, weights.sum(1), levels)
    real = weights if factors is None else weights * factors[:, None]
    real = real / real.sum(1).max()
    transmittance, time = solve_filter(real, STEP_NM, steepest=STEEPEST, longest=LONGEST)
    before, after = real.sum(1), time * real @ transmittance
    found = RegulatingFilter(
        grid, transmittance, studio.labels, before / before.max(), after / after.max(), time
    )
    if factors is None:
        return found
    scaled = weights / weights.sum(1).max()
    modelled, _ = solve_filter(scaled, STEP_NM, steepest=STEEPEST, longest=LONGEST)
    behind = real @ modelled
    notes = tuple(
        f"{label} records {factor:.2g} times the signal predicted from sensitivities and light, relative to the others: check the "
        "sensitivities, the spectrum of the light and the filters before the lens"
        for label, factor in zip(studio.labels, factors, strict=True)
        if not 1 / FAR_OFF < factor < FAR_OFF
    )
    return replace(
        found,
        factors=factors,
        modelled=modelled,
        model_alone=float(behind.min() / behind.max()),
        notes=notes,
    )


def _factors(
    setup: StudioSetup, camera: StudioCamera, modelled: np.ndarray, levels: Mapping[str, float]
) -> np.ndarray:
    """Return measured over modelled signal of each channel, geometric mean 1."""
    missing = [label for label in camera.labels if label not in levels]
    if missing:
        raise PlanRefused(
            value_problem(
                str(setup.path), f"cameras.{camera.name}", f"the white has no {', '.join(missing)}",
                ", ".join(levels) or "no channel", ", ".join(camera.labels),
                "Give the white of every sensor, and --pattern with the names of the sensitivities' columns.",
                "E_CHANNELS",
            )
        )  # fmt: skip
    measured = np.array([levels[label] for label in camera.labels], float)
    dark = [label for label, level in zip(camera.labels, measured, strict=True) if not level > 0]
    if dark:
        raise PlanRefused(
            value_problem(
                str(setup.path), f"cameras.{camera.name}", f"{', '.join(dark)} of the white is not above black",
                f"{measured.min():.3g} counts a second", "more than 0",
                "Capture the white longer, with its darks.", "E_WHITE_DARK",
            )
        )  # fmt: skip
    ratio = measured / np.maximum(modelled, 1e-30)
    return np.asarray(ratio / np.exp(np.log(ratio).mean()))


def _tent(centre: float, step: float) -> np.ndarray:
    """Linear interpolation between even wavelengths, as weights at `spectra.GRID`."""
    return np.maximum(1 - np.abs(GRID - centre) / step, 0)
