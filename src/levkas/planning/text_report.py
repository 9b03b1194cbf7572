"""Plans as records for programs and as text for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from levkas.planning.exposure_plan import plan_exposure
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
    """Return a light record in lines: all lightings side by side; the page has what one does to the object."""
    lines = [
        f"{'setup':<14}{'lx':>6}{'drop':>7}{'varnish':>9}{'gold':>7}{'texture':>9}{'hidden':>8}"
    ]
    for one in record["setups"]:
        lux = f"{one['mean']:.0f}" if one["absolute"] else "–"
        varnish, gold = (f"{100 * v:.2g} %" if (v := one[k]) else "–" for k in ("varnish", "gold"))
        lines.append(
            f"{one['setup']:<14}{lux:>6}{100 * one['drop']:>5.0f} %{varnish:>9}{gold:>7}"
            f"{100 * one['texture_varnished']:>7.1f} %{100 * one['hidden']:>6.1f} %"
        )
    if "optimum" in record:
        best = f"{record['optimum']['angle_deg']:.0f}° from the normal"
        lines.append(f"\nBest angle of the lamps of {record['light']['setup']}: {best}")
    lines += [f"\n{words}" for words in dict.fromkeys(record["contradictions"])]
    if "report" in record:
        lines.append(f"Written: {record['report']}")
    return "\n".join(lines)


def framing_text(found: list[Framing]) -> str:
    """Return framings in lines."""
    lines = []
    for f in found:
        mtf = ", ".join(f"{v:.2f} at {k}" for k, v in f.mtf.items())
        lines.append(
            f"{f.camera}: {f.field_mm[0]:.0f} x {f.field_mm[1]:.0f} mm from {f.distance_mm / 10:.0f} cm, "
            f"{f.samples_per_mm:.2f} samples a mm, sharp over "
            f"{f.depth_of_field_mm:.0f} mm, diffraction leaves {mtf}"
        )
        lines += [f"  {words}" for words in f.contradictions]
    return "\n".join(lines) or "no camera is declared"


def exposure_record(path: str | Path, name: str | None = None) -> dict[str, Any]:
    """Return exposures of one lighting."""
    return {"cameras": [e.to_dict() for e in plan_exposure(load_setup(path), name)]}


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
    return "\n".join(lines)
