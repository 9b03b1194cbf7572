"""The plan as one HTML page, for a conservator and a lighting technician; it prints on A4."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.illuminants import illuminant
from levkas.core.files import write_text
from levkas.pages.page import render_page
from levkas.pages.plan_plots import (
    draw_bench,
    draw_evenness,
    draw_glare,
    draw_snr,
    draw_spectra,
)
from levkas.planning.exposure_plan import plan_exposure
from levkas.planning.framing import plan_framing
from levkas.planning.light import compare_lightings, plan_light
from levkas.planning.optimisation import MEANINGS, TOLERANCES, WEIGHTS, optimise
from levkas.planning.spectra import GRID, colour_temperature, unevenness
from levkas.planning.tables import PlanRefused

if TYPE_CHECKING:
    from levkas.planning.light import LightPlan
    from levkas.planning.setup import StudioLamp, StudioSetup


def write_report(
    path: str | Path,
    setup: StudioSetup,
    name: str | None = None,
) -> Path:
    """Write the report of one lighting, beside all others of the setup file.

    Parameters
    ----------
    path : path
        HTML file.
    setup : StudioSetup
    name : str, optional
        Of the lighting; the first without one.

    Raises
    ------
    PlanRefused
        Where there is no such lighting.
    """
    page = report_facts(setup, name)
    write_text(path, render_page("plan.html", page=page))
    return Path(path)


def report_facts(
    setup: StudioSetup,
    name: str | None,
) -> dict[str, Any]:
    """Return everything on the page: words, numbers and drawings."""
    plan = plan_light(setup, name)
    best = optimise(setup, plan.lighting)
    thing = setup.object
    facts: dict[str, Any] = {
        "title": setup.bench.title or setup.path.stem,
        "object": thing.title or "The object",
        "facts": _object_facts(setup),
        "name": plan.lighting.name,
        "subtitle": plan.lighting.title,
        "short": _in_short(setup, plan),
        "lamps": [_lamp_row(lamp) for lamp in plan.lighting.lamps],
        "bench": draw_bench(setup, plan),
        "evenness": draw_evenness(plan),
        "glare": draw_glare(plan),
        "compared": compare_lightings(setup),
        "best": best,
        "best_words": f"These lamps at {best.angle_deg:.0f}° from the normal, their distances and aims as they are.",
        "criteria": [
            (MEANINGS[k], f"{v:.2f}", f"{TOLERANCES[k]:g}", f"{WEIGHTS[k]:g}")
            for k, v in best.criteria.items()
            if v or k not in ("varnish", "gold")
        ],
        "framing": plan_framing(setup),
        "spectra": _spectra(plan),
        "spectra_words": _spectra_words(plan),
    }
    return {**facts, **_light_facts(setup, plan)}


def _light_facts(setup: StudioSetup, plan: LightPlan) -> dict[str, Any]:
    """Exposure, or the reason why there is none."""
    if not setup.cameras:
        return {"exposures": [], "no_light": ""}
    try:
        exposures = plan_exposure(setup, plan.lighting.name)
    except PlanRefused as refused:
        return {"exposures": [], "no_light": str(refused)}
    return {"exposures": exposures, "snr": draw_snr(exposures), "no_light": ""}


def _object_facts(setup: StudioSetup) -> list[str]:
    thing = setup.object
    lines = [f"{thing.size_mm[0]:.0f} x {thing.size_mm[1]:.0f} mm"]
    if thing.recess_mm:
        lines.append(f"middle {thing.recess_mm:g} mm lower")
    lines += [n for n, there in (("varnished", thing.varnish), ("gilded", thing.gold)) if there]
    return lines


def _in_short(setup: StudioSetup, plan: LightPlan) -> list[tuple[str, str]]:
    """Return what a hurried reader takes away: (ok, warn or refuse; sentence)."""
    thing = setup.object
    lines = [
        (
            _mark(plan.drop, 0.10, 0.25),
            f"Evenness: the light falls by {100 * plan.drop:.0f} % from the brightest to the darkest place "
            f"of the object. The flat field repairs it, at the cost of some noise where it is dark.",
        )
    ]
    if thing.varnish:
        veil = plan.varnish / thing.darkest
        lines.append(
            (
                _mark(veil, 0.10, 0.25),
                f"Varnish: a veil of {100 * plan.varnish:.2g} % of white, which is {100 * veil:.0f} % of the "
                f"darkest paint.",
            )
        )
    if thing.gold:
        lines.append(
            (
                _mark(plan.gold, 0.35, 0.7),
                f"Gold reads up to {100 * plan.gold:.0f} % of white and varies {plan.gold_spread:.1f}-fold "
                f"over the panel.",
            )
        )
    if thing.relief_slope:
        flat = plan.texture < 0.01
        words = (
            "is flattened" if flat else "is exaggerated" if plan.hidden > 0.05 else "stays visible"
        )
        lines.append(
            (
                "warn" if flat or plan.hidden > 0.05 else "ok",
                f"Relief {words}: contrast {100 * plan.texture:.1f} % on matte paint, "
                f"{100 * plan.hidden:.1f} % of it turned away from a lamp.",
            )
        )
    missing = [f.camera for f in plan_framing(setup) if not f.covers]
    if missing:
        lines.append(
            ("refuse", f"{', '.join(missing)} cannot show the whole object from their positions.")
        )
    return lines


def _mark(value: float, good: float, bad: float) -> str:
    return "ok" if value <= good * 1.005 else "warn" if value <= bad else "refuse"


def _lamp_row(lamp: StudioLamp) -> dict[str, str]:
    target = lamp.place - lamp.axis * lamp.place[2] / min(lamp.axis[2], -1e-6)
    x, y, z = lamp.place / 10
    return {
        "name": lamp.name,
        "angle": f"{lamp.angle_deg:.0f}°",
        "distance": f"{lamp.distance_mm / 10:.0f} cm",
        "place": f"{_side(x, 'right', 'left')}, {_side(y, 'below', 'above')}, {z:.0f} cm out",
        "aim": _aimed(target / 10),
        "filters": ", ".join(lamp.filters) or "none",
        "polariser": lamp.polariser or "–",
    }


def _side(value: float, more: str, less: str) -> str:
    if abs(value) < 0.5:
        return "level" if more == "below" else "in the middle"
    return f"{abs(value):.0f} cm {more if value > 0 else less}"


def _aimed(target: np.ndarray) -> str:
    if np.hypot(target[0], target[1]) < 0.5:
        return "the middle"
    return f"{_side(target[0], 'right', 'left')}, {_side(target[1], 'below', 'above')}"


def _spectra(plan: LightPlan) -> str:
    lamp = plan.lighting.lamps[0]
    curves = {"the lamp with its filters": lamp.spectrum}
    for name in ("D50", "D65", "A"):
        found = illuminant(name)
        assert found is not None
        curves[f"CIE {name}"] = np.interp(GRID, *found)
    return draw_spectra(GRID, curves, "spectrum of the light beside CIE illuminants")


def _spectra_words(plan: LightPlan) -> str:
    lamp = plan.lighting.lamps[0]
    kelvin, duv = colour_temperature(lamp.spectrum)
    return (
        f"The light has {kelvin:,.0f} K (Duv {duv:+.4f}); between 400 and 720 nm its strongest wavelength "
        f"has {unevenness(lamp.spectrum):.1f} times the power of its weakest."
    )
