"""The report section on noise, dynamic range, glare, focus and light."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.pages.budget import describe_number
from levkas.pages.page import Figure
from levkas.pages.plots import Line, colour_of, light_map, plot

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np

SOFT = 1.5
"""A band's blur over that of the sharpest one, from which on it is named."""
LOW_SNR = 10.0


class RadiometryRow(NamedTuple):
    """One layer in the table of an object's radiometry; texts, ready to be shown."""

    name: str
    noise: str
    snr: str
    scene: str
    glare: str
    focus: str
    notes: Sequence[str] = ()
    glare_share: float | None = None
    noise_median: float | None = None


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
    sensors = [one["sensor"]["stops"] for one in measured.values() if "sensor" in one]
    focus = [f for f in focus if f["blur_px"] is not None]
    middle, share = _noise_median(ranges), _glare_share(resampled.get("glare", {}), quantity)
    unit = "" if quantity == "reflectance" else f" {quantity}"
    return RadiometryRow(
        name,
        "–" if middle is None else describe_number(middle) + unit,
        _snr(ranges),
        f"{max(r['stops'] for r in ranges):.1f} stops",
        "not measured" if share is None else f"{100 * share:.2g} %",
        _focus(focus),
        [*_notes_of_range(ranges, sensors), *_notes_of_bands(ranges, focus)],
        share,
        None if unit else middle,
    )


def _noise_median(ranges: Sequence[Mapping[str, Any]]) -> float | None:
    known = [r["noise"] for r in ranges if r["noise"] is not None]
    return median(known) if known else None


def _glare_share(glare: Mapping[str, int], quantity: str) -> float | None:
    looked = quantity == "reflectance" and glare.get("inside")
    return glare["glare"] / glare["inside"] if looked else None


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


def _focus(known: Sequence[Mapping[str, Any]]) -> str:
    if not known:
        return "no edges to measure"
    ends = [pick(known, key=lambda f: f["blur_px"]) for pick in (min, max)]
    texts = [f"{f['blur_px']:.2f} px ({f['band']})" for f in ends]
    return " to ".join(dict.fromkeys(texts))


def _notes_of_range(ranges: Sequence[Mapping[str, Any]], sensors: Sequence[float]) -> list[str]:
    worst = max(ranges, key=lambda r: r["clipped"])
    notes = []
    if worst["clipped"] > 5e-4:
        notes.append(
            f"The scene goes beyond the sensor: {100 * worst['clipped']:.2g} % saturates in {worst['band']}. "
            "Expose shorter, merge exposures, or move lamps out of the mirror's angle."
        )
    stops = max(r["stops"] for r in ranges)
    if sensors and stops > min(sensors):
        notes.append(
            f"The scene spans {stops:.1f} stops, the sensor {min(sensors):.1f}: its darkest parts are noise. "
            "Average more shots, or merge exposures."
        )
    return notes


def _notes_of_bands(
    ranges: Sequence[Mapping[str, Any]], focus: Sequence[Mapping[str, Any]]
) -> Iterator[str]:
    low = [r["band"] for r in ranges if r["snr"] is not None and r["snr"] < LOW_SNR]
    if low:
        yield f"The median SNR is below {LOW_SNR:g} in {_few(low)}: more light or more shots there."
    best = min((f["blur_px"] for f in focus), default=0.0)
    soft = [f["band"] for f in focus if f["blur_px"] > max(SOFT * best, best + 0.5)]
    if soft:
        yield f"Softer than the sharpest band: {_few(soft)}. Focus there anew at the next capture, and compare its spectra away from edges."


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


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
