"""What a session costs the object: illuminance, lux-hours, ultraviolet and heat against its class.

Classes and limits as CIE 157:2004 has them (illuminance and lux-hours a year): high responsivity 50 lx
and 15,000 lx·h, medium 50 lx and 150,000 lx·h, low 200 lx and 600,000 lx·h, none without limit; and
the usual 75 µW of ultraviolet a lumen. Low and medium agree with the allowances that the National Gallery,
London, publishes; 50 lx of high and medium and 200 lx of low are cited from it elsewhere; the 15,000 lx·h of high were
not found in a second source (docs/planning.md). Limits are those of display: a capture may be brighter if it is
short, what counts is the dose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.planning.exposing import CameraExposure, irradiance_spectrum, plan_exposure
from levkas.planning.spectra import GRID, LUMENS_PER_WATT, eye, integrate

if TYPE_CHECKING:
    from levkas.planning.setup import Setup

CLASSES: dict[str, tuple[float, float]] = {
    "high": (50.0, 15_000.0),
    "medium": (50.0, 150_000.0),
    "low": (200.0, 600_000.0),
    "none": (float("inf"), float("inf")),
}
"""Illuminance lx and lux-hours a year of CIE 157:2004."""
MOST_UV = 75.0
"""µW/lm."""
ABSORBED, FILM = 0.8, 10.0
"""Share of light that a dark panel takes up, and W/m²/K that still air carries off."""


@dataclass(frozen=True)
class Dose:
    """What one object gets in one session; shares are of a year's limit of its class."""

    setup: str
    illuminance_lx: float
    hours: float
    lux_hours: float
    sensitivity: str
    limit_lx: float
    limit_lux_hours: float
    share_of_year: float
    uv_uw_per_lm: float
    heat_w_per_m2: float
    warming_k: float
    sentences: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {**self.__dict__, "sentences": list(self.sentences)}


def plan_dose(
    setup: Setup, name: str | None = None, *, exposures: list[CameraExposure] | None = None
) -> Dose:
    """Return what the object of a setup file gets under one lighting, all cameras together.

    Raises
    ------
    PlanRefused
        Where there is no such lighting, or its strength is not known.
    """
    lighting, session = setup.lighting(name), setup.bench.session
    spectrum = irradiance_spectrum(setup, lighting)
    exposures = plan_exposure(setup, name) if exposures is None else exposures
    lux = LUMENS_PER_WATT * integrate(spectrum * eye())
    capture = sum(e.total_s + session.pause_s for e in exposures) * session.shots / 3600
    hours = session.hours or capture + (session.warm_up_min + session.focus_min) / 60
    most_lx, most_dose = CLASSES[setup.object.sensitivity]
    uv = 1e6 * integrate(spectrum * (GRID < 400)) / lux
    heat = integrate(spectrum)
    warming = ABSORBED * heat / FILM
    dose = Dose(
        lighting.name, lux, hours, lux * hours, setup.object.sensitivity, most_lx, most_dose,
        lux * hours / most_dose, uv, heat, warming, (),
    )  # fmt: skip
    return Dose(**{**dose.__dict__, "sentences": tuple(_say(dose))})


def _say(dose: Dose) -> list[str]:
    told = [
        f"{dose.illuminance_lx:.0f} lx for {dose.hours:.1f} h are {dose.lux_hours:,.0f} lx·h"
        + (
            f": {100 * dose.share_of_year:.2g} % of what an object of {dose.sensitivity} responsivity "
            f"may get in a year ({dose.limit_lux_hours:,.0f} lx·h)."
            if np.isfinite(dose.limit_lux_hours)
            else "; the object is not sensitive to light."
        )
    ]
    if dose.illuminance_lx > dose.limit_lx:
        told.append(
            f"While the lamps burn the object is lit {dose.illuminance_lx / dose.limit_lx:.1f} times as "
            f"brightly as on display ({dose.limit_lx:.0f} lx): switch them off between captures."
        )
    uv = "within" if dose.uv_uw_per_lm <= MOST_UV else "above"
    told.append(f"Ultraviolet is {dose.uv_uw_per_lm:.0f} µW/lm, {uv} the usual {MOST_UV:.0f}.")
    told.append(
        f"The light brings {dose.heat_w_per_m2:.1f} W/m²: a dark panel in still air would settle at most "
        f"{dose.warming_k:.1f} K above the room."
    )
    return told


def annual_share(lux: float, hours: float, sensitivity: str) -> float:
    """Return the share of a year's lux-hours of a class.

    >>> round(annual_share(216.0, 2.0, "high"), 4)
    0.0288
    """
    return lux * hours / CLASSES[sensitivity][1]
