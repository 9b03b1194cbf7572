"""Plans as records for programs and as text for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from levkas.planning.exposure_plan import plan_dose, plan_exposure
from levkas.planning.framing import Framing, plan_framing
from levkas.planning.light import compare_lightings, plan_light
from levkas.planning.loading import load_setup


def light_record(
    path: str | Path, name: str | None = None, *, optimised: bool = False
) -> dict[str, Any]:
    """Return the plan of one lighting, the others beside it, and the optimum where it is wanted."""
    setup = load_setup(path)
    record: dict[str, Any] = {
        "light": plan_light(setup, name).to_dict(),
        "setups": [p.to_dict() for p in compare_lightings(setup)],
        "contradictions": [c for f in plan_framing(setup) for c in f.contradictions],
    }
    if optimised:
        from levkas.planning.optimisation import optimise

        record["optimum"] = optimise(setup, setup.lighting(name)).to_dict()
    return record


def light_text(record: dict[str, Any]) -> str:
    """Return a light record in lines."""
    this = record["light"]
    unit = "lx" if this["absolute"] else "(relative)"
    lines = [
        f"{this['setup']}: mean light {this['mean']:.0f} {unit}, drop {100 * this['drop']:.1f} % over the object",
        *_shine_lines(this),
    ]
    for name, field in this["bright_field"].items():
        lines.append(
            f"  bright field along the {name}: {field['mirror'][1]:.0f}° from the normal"
            + (
                f", with facets {field['facets'][1]:.0f}°"
                if this["varnish"] or this["gold"]
                else ""
            )
            + (f"; margin {field['margin']:.0f}°" if np.isfinite(field["margin"]) else "")
        )
    lines += ["", f"{'setup':<14}{'lx':>6}{'drop':>7}{'varnish':>9}{'gold':>7}{'texture':>9}"]
    for other in record["setups"]:
        lux = f"{other['mean']:.0f}" if other["absolute"] else "–"
        varnish, gold = (
            f"{100 * v:.2g} %" if (v := other[k]) else "–" for k in ("varnish", "gold")
        )
        lines.append(
            f"{other['setup']:<14}{lux:>6}{100 * other['drop']:>5.0f} %{varnish:>9}{gold:>7}"
            f"{100 * other['texture_varnished']:>7.1f} %"
        )
    if "optimum" in record:
        lines += [
            "",
            f"Best angle of these lamps: {record['optimum']['angle_deg']:.0f}° from the normal",
        ]
        lines += [f"  {words}" for words in record["optimum"]["reasons"]]
    lines += [f"\n{words}" for words in dict.fromkeys(record["contradictions"])]
    if "report" in record:
        lines.append(f"Written: {record['report']}")
    return "\n".join(lines)


def _shine_lines(this: dict[str, Any]) -> list[str]:
    """Return the lines on varnish, gold and relief, each where it is there."""
    shines = []
    if this["varnish"]:
        shines.append(f"varnish shines up to {100 * this['varnish']:.2g} % of white")
    if this["gold"]:
        shines.append(
            f"gold up to {100 * this['gold']:.0f} %, {this['gold_spread']:.1f}-fold over the panel"
        )
    lines = [
        f"  {', '.join(shines)} (GGX facets)"
        if shines
        else "  nothing on it shines: matte, no gold"
    ]
    varnished = f", {100 * this['texture_varnished']:.1f} % with varnish" if this["varnish"] else ""
    lines.append(
        f"  relief: contrast {100 * this['texture']:.1f} % matte{varnished}; "
        f"{100 * this['hidden']:.1f} % turned away from a lamp"
    )
    if this["varnish"]:
        darker = 100 * (1 - this["darkening"])
        lines.append(f"  paint under varnish reads {darker:.0f} % darker than at 45°")
    return lines


def framing_text(found: list[Framing]) -> str:
    """Return framings in lines."""
    lines = []
    for f in found:
        mtf = ", ".join(f"{v:.2f} at {k}" for k, v in f.mtf.items())
        lines.append(
            f"{f.camera}: {f.field_mm[0]:.0f} x {f.field_mm[1]:.0f} mm from {f.distance_mm / 10:.0f} cm, "
            f"{f.samples_per_mm:.2f} samples a mm ({f.samples_per_mm2:.1f} a mm²), sharp over "
            f"{f.depth_of_field_mm:.0f} mm, diffraction leaves {mtf}"
        )
        lines += [f"  {words}" for words in f.contradictions]
    return "\n".join(lines) or "no camera is declared"


def exposure_record(path: str | Path, name: str | None = None) -> dict[str, Any]:
    """Return exposures and dose of one lighting."""
    setup = load_setup(path)
    exposures = plan_exposure(setup, name)
    return {
        "cameras": [e.to_dict() for e in exposures],
        "dose": plan_dose(setup, name, exposures=exposures).to_dict(),
    }


def exposure_text(record: dict[str, Any]) -> str:
    """Return an exposure record in lines."""
    lines = []
    for camera in record["cameras"]:
        channels = camera["channels"]
        times = sorted({round(c["time_s"], 4) for c in channels})
        span = f"{times[0]:.3g}" + (f" to {times[-1]:.3g}" if len(times) > 1 else "") + " s"
        worst = min(channels, key=lambda c: c["snr"])
        lines.append(
            f"{camera['camera']} under {camera['setup']}: {span}; weakest {camera['limiting']}, SNR "
            f"{worst['snr']:.0f} ({worst['snr_db']:.1f} dB of Eq. 1); best over worst {camera['evenness']:.1f}"
        )
        lines += [f"  {words}" for words in camera["notes"]]
    lines += ["", *record["dose"]["sentences"]]
    return "\n".join(lines)
