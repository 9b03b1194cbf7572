"""The report section on noise, dynamic range, glare, focus and light."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Any

from levkas.pages.budget import describe_number
from levkas.pages.page import Figure
from levkas.pages.plots import Line, colour_of, light_map, plot

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

SOFT = 1.5
"""A band's blur over that of the sharpest one, from which on it is named."""
LOW_SNR = 10.0


@dataclass(frozen=True)
class RadiometryRow:
    """One layer in the table of an object's radiometry; texts, ready to be shown."""

    name: str
    noise: str
    snr: str
    scene: str
    sensor: str
    glare: str
    focus: str
    light: str
    notes: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    glare_share: float | None = None
    noise_median: float | None = None


SHOWN_LAMP = 0.001
"""Standard deviation of the lamp between white and object, relative, from which a report gives it."""


def describe_layer(
    name: str, calibrated: Mapping[str, Any], resampled: Mapping[str, Any]
) -> RadiometryRow | None:
    """Return the row of a layer from what its stages noted, None where these noted nothing."""
    ranges = [r for r in resampled.get("ranges", []) if r["stops"] is not None]
    if not ranges:
        return None
    measured, focus = calibrated.get("measured", {}), calibrated.get("focus", [])
    of_sensels = {b: m for one in measured.values() for b, m in one.get("sensels", {}).items()}
    ranges = [{**r, **of_sensels.get(r["band"], {})} for r in ranges]
    quantity = str(calibrated.get("quantity", ""))
    stops = max(r["stops"] for r in ranges)
    sensors = [one["sensor"]["stops"] for one in measured.values() if "sensor" in one]
    notes = [
        *_notes_of_range(ranges, sensors, quantity),
        *_notes_of_snr(ranges),
        *_notes_of_focus(focus),
    ]
    return RadiometryRow(
        name,
        _noise(ranges, quantity),
        _snr(ranges),
        f"{stops:.1f} stops",
        f"{min(sensors):.1f} stops" if sensors else "–",
        _glare(resampled.get("glare", {}), quantity),
        _focus(focus),
        _light(measured),
        tuple(notes),
        tuple(_figures(ranges, focus)),
        _glare_share(resampled.get("glare", {}), quantity),
        _noise_median(ranges) if quantity == "reflectance" else None,
    )


def _noise_median(ranges: Sequence[Mapping[str, Any]]) -> float | None:
    known = [r["noise"] for r in ranges if r["noise"] is not None]
    return median(known) if known else None


def _glare_share(glare: Mapping[str, int], quantity: str) -> float | None:
    looked = quantity == "reflectance" and glare.get("inside")
    return glare["glare"] / glare["inside"] if looked else None


def _noise(ranges: Sequence[Mapping[str, Any]], quantity: str) -> str:
    """Return the median noise of the bands.

    >>> _noise([{"noise": 617.3}], "counts"), _noise([{"noise": 0.00213}], "reflectance")
    ('617 counts', '0.0021')
    """
    middle = _noise_median(ranges)
    if middle is None:
        return "–"
    return describe_number(middle) + ("" if quantity == "reflectance" else f" {quantity}")


def _snr(ranges: Sequence[Mapping[str, Any]]) -> str:
    """Report the middle of the bands and the least; values below black have no decibels.

    >>> _snr([{"snr": 100.0}, {"snr": None}]), _snr([{"snr": -2.0}])
    ('100 (20.0 dB, 10·log10), least 100', '-2, least -2')
    """
    import math

    known = [r["snr"] for r in ranges if r["snr"]]
    if not known:
        return "–"
    middle, least = median(known), min(known)
    decibels = f" ({10 * math.log10(middle):.1f} dB, 10·log10)" if middle > 0 else ""
    return f"{middle:.0f}{decibels}, least {least:.0f}"


def _glare(glare: Mapping[str, int], quantity: str) -> str:
    part = _glare_share(glare, quantity)
    if part is None:
        return "not measured"
    share = 100 * part
    signs = {
        "saturated": "saturated",
        "bright": "brighter than paint",
    }
    parts = [
        f"{text} {100 * glare[key] / glare['inside']:.2g} %"
        for key, text in signs.items()
        if glare.get(key)
    ]
    text = f"{share:.2g} %" + (f" ({', '.join(parts)})" if parts else "")
    veiled = glare.get("veiled", 0) / glare["inside"]
    return text + (f"; {100 * veiled:.2g} % veiled, against the default setup" if veiled else "")


def _focus(focus: Sequence[Mapping[str, Any]]) -> str:
    known = [f for f in focus if f["blur_px"] is not None]
    if not known:
        return "no edges to measure"
    best, worst = (pick(known, key=lambda f: f["blur_px"]) for pick in (min, max))
    if best["blur_px"] == worst["blur_px"]:
        return f"{best['blur_px']:.2f} px"
    return (
        f"{best['blur_px']:.2f} px ({best['band']}) to {worst['blur_px']:.2f} px ({worst['band']})"
    )


def _light(measured: Mapping[str, Any]) -> str:
    fields = [f for one in measured.values() for f in one.get("light", {}).values()]
    levels = [f["uniformity"] for f in fields if "uniformity" in f]
    if not levels:
        return fields[0]["refused"] if fields else "–"
    lamp = [
        one["sigma"]
        for of_sensor in measured.values()
        for one in of_sensor.get("lamp", {}).values()
    ]
    known = f"; lamp ± {100 * max(lamp):.2g} %" if lamp and max(lamp) >= SHOWN_LAMP else ""
    return f"{100 * min(levels):.0f} % of the brightest{known}"


def _notes_of_range(
    ranges: Sequence[Mapping[str, Any]], sensors: Sequence[float], quantity: str
) -> list[str]:
    clipped = [r for r in ranges if r["clipped"] > 5e-4]
    worst = max(clipped, key=lambda r: r["clipped"], default=None)
    notes = []
    if worst is not None:
        notes.append(
            f"The scene goes beyond the sensor: {100 * worst['clipped']:.2g} % saturates in {worst['band']}. "
            # A plain photograph or radiograph has no lamps that are known of.
            + (
                "Move the lamps out of the mirror's angle, or merge exposures."
                if quantity == "reflectance"
                else "Take it with a shorter exposure."
            )
        )
    stops = max(r["stops"] for r in ranges)
    if sensors and stops > min(sensors):
        notes.append(
            f"The scene spans {stops:.1f} stops, the sensor {min(sensors):.1f}: its darkest parts are noise. "
            "Average more shots, or merge exposures."
        )
    return notes


def _notes_of_snr(ranges: Sequence[Mapping[str, Any]]) -> list[str]:
    low = [r["band"] for r in ranges if r["snr"] is not None and r["snr"] < LOW_SNR]
    if not low:
        return []
    return [f"The median SNR is below {LOW_SNR:g} in {_few(low)}: more light or more shots there."]


def _notes_of_focus(focus: Sequence[Mapping[str, Any]]) -> list[str]:
    known = [f for f in focus if f["blur_px"] is not None]
    if not known:
        return []
    best = min(f["blur_px"] for f in known)
    soft = [f["band"] for f in known if f["blur_px"] > max(SOFT * best, best + 0.5)]
    if not soft:
        return []
    return [
        f"Softer than the sharpest band: {_few(soft)}. Focus there anew at the next capture, and compare its spectra away from edges."
    ]


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _figures(
    ranges: Sequence[Mapping[str, Any]], focus: Sequence[Mapping[str, Any]]
) -> list[Figure]:
    """Signal-to-noise and focus over the bands, where there are enough of them to see a course."""
    figures = []
    places, axis = _places([r["band"] for r in ranges])
    snr = [r["snr"] for r in ranges]
    if axis.startswith("wave") and len(ranges) > 3 and any(snr):
        svg = plot([Line("SNR", places, snr)], x=axis, y="median SNR (linear)", from_zero=True)
        figures.append(Figure(svg, "Median of value over sigma, band by band."))
    places, axis = _places([f["band"] for f in focus])
    blur = [f["blur_px"] for f in focus]
    if axis.startswith("wave") and len([b for b in blur if b is not None]) > 3:
        svg = plot([Line("blur", places, blur)], x=axis, y="blur of edges, px", from_zero=True)
        caption = (
            "Blur of the picture's own edges in native pixels; one band is in focus, others drift."
        )
        figures.append(Figure(svg, caption))
    return figures


def _places(labels: Sequence[str]) -> tuple[list[float], str]:
    """Wavelengths where all labels are ones, else numbers of bands."""
    try:
        return [float(label.removesuffix(" nm")) for label in labels], "wavelength, nm"
    except ValueError:
        return [float(i + 1) for i in range(len(labels))], "band"


# --- the camera's light -------------------------------------------------------------------------


def draw_light(record: Mapping[str, Any], levels: np.ndarray, label: str) -> list[Figure]:
    """Return the map of a light field and its two profiles, as the paper's Figure 6b."""
    width, height = record["size"]
    x, y, across, down = record["rectangle"]
    rows, columns = levels.shape
    figures = []
    if rows > 1:
        caption = (
            f"Light times vignetting on the white, {label}. Green: the largest rectangle in which it drops "
            f"by {100 * record['drop']:.0f} % at most, {across} x {down} px at ({x}, {y}), "
            f"{100 * record['share']:.0f} % of the field. Red: where the profiles run."
        )
        figures.append(Figure(light_map(levels, record["size"], record["rectangle"]), caption))
    step_x, step_y = record["step"]
    lines = [
        Line("middle row", [(c + 0.5) * step_x for c in range(columns)], list(levels[rows // 2]))
    ]
    if rows > 1:
        column = list(levels[:, columns // 2])
        places = [(r + 0.5) * step_y for r in range(rows)]
        lines.append(Line("middle column", places, column, "tgt"))
    svg = plot(lines, x="native px", y="share of the brightest")
    figures.append(Figure(svg, f"Profiles of the light, {label}; {width} x {height} px."))
    return figures


def channel_colours(labels: Sequence[str]) -> list[str]:
    """Return a colour for every channel."""
    places, axis = _places(labels)
    known = axis.startswith("wavelength")
    # B1 to B9 are numbers of bands, not nine blues.
    alike = len(labels) > 2 and len({label.rstrip("0123456789") for label in labels}) == 1
    return [
        colour_of("" if alike else label, i, len(labels), places[i] if known else float("nan"))
        for i, label in enumerate(labels)
    ]
