"""Colour, tone, white balance and uniformity of a chart, beside the levels of FADGI and ISO 19264-1.

Indicators, never certification: those standards want their own targets, densities and whole systems.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.colour.srgb import observer_under_d65, visible_coverage, xyz_weights

if TYPE_CHECKING:
    from levkas.quality.targets.charts import Chart, ChartReference

LEVELS = {
    "colour": ((2.0, 3.5, 5.0, 6.5), (4.0, 5.0, 5.0)),
    "worst": ((), (10.0, 15.0, 15.0)),
    "tone": ((1.5, 3.0, 4.5, 6.0), (2.0, 3.0, 4.0)),
    "white": ((2.0, 4.0, 6.0, 8.0), (3.0, 4.0, 5.0)),
}
"""FADGI 2023 (4 to 1 stars) and ISO 19264-1:2021 (levels A, B, C): largest values."""
LEAST_COVERAGE = 0.9


class IndicatorRow(NamedTuple):
    """One indicator: what, how much, and the level that the value alone would reach."""

    name: str
    value: float
    unit: str
    fadgi: str
    iso: str

    def to_dict(self) -> dict[str, Any]:
        """Return the row for `--json`."""
        return self._asdict()


class Colours(NamedTuple):
    """CIELAB (D65, 2°) of every patch as measured and as referred to, and ΔE2000 between them."""

    measured: np.ndarray
    wanted: np.ndarray
    difference: np.ndarray
    how: str


def compare_colours(
    means: np.ndarray, wavelengths: np.ndarray, chart: Chart, reference: ChartReference
) -> Colours:
    """Compare the patches' colours with those of the reference spectra.

    Parameters
    ----------
    means : ndarray, (patches, bands)
        Reflectance.
    wavelengths : ndarray, (bands,), nm
        NaN for broad channels.
    chart : Chart
    reference : Reference

    Notes
    -----
    Bands that cover the visible range are integrated. From others a linear matrix to XYZ is fitted
    to the chart itself, each patch by the matrix of all the others: an upper bound of what a
    profile would leave, and no measure of the camera's lighting.
    """
    grid, _ = observer_under_d65()
    spectra = reference.at(np.clip(grid, reference.wavelengths[0], reference.wavelengths[-1]))
    wanted = spectra @ observer_under_d65()[1]
    narrow = np.isfinite(wavelengths)
    covered = narrow.sum() >= 8 and visible_coverage(wavelengths[narrow]) >= LEAST_COVERAGE
    if covered:
        measured = means[:, narrow] @ xyz_weights(wavelengths[narrow])
        how = f"integrated over {int(narrow.sum())} bands"
    else:
        measured = _left_out(means, wanted)
        how = f"by a matrix from {means.shape[1]} channels, each patch left out in turn"
    a, b = lab_of(measured), lab_of(wanted)
    return Colours(a, b, delta_e_2000(a, b), how)


def _left_out(means: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    guessed = np.empty_like(wanted)
    for i in range(len(means)):
        others = np.arange(len(means)) != i
        guessed[i] = means[i] @ np.linalg.lstsq(means[others], wanted[others], rcond=1e-6)[0]
    return guessed


def lab_of(xyz: np.ndarray) -> np.ndarray:
    """Return CIELAB of XYZ under D65, white Y = 1; what is below black is black.

    >>> [round(float(v)) for v in lab_of(np.array([0.9505, 1.0, 1.089]) / 2)]
    [76, 0, 0]
    """
    white = observer_under_d65()[1].sum(0)
    t = np.maximum(np.asarray(xyz, float) / white, 0)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1
    )


def delta_e_2000(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ΔE2000 of CIELAB colours, as colour-science computes it (CIE 142-2001).

    >>> [round(float(d), 4) for d in delta_e_2000(np.array([[50, 2.6772, -79.7751]]), np.array([[50, 0, -82.7485]]))]
    [2.0425]
    """
    # colour-science sets numpy's printing back to that of version 1.13 for the whole process.
    with np.printoptions():
        from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(a, b), float)


def rate(colours: Colours, chart: Chart, *, uniformity: float | None = None) -> list[IndicatorRow]:
    """Return the indicator rows of a chart.

    Parameters
    ----------
    colours : Colours
    chart : Chart
    uniformity : float, optional
        Least over greatest level of the light on the white, 0 … 1.
    """
    greys = list(chart.greys)
    tone = colours.measured[greys, 0] - colours.wanted[greys, 0]
    # White balance: what grey gained in colour, over what the reference's own grey has.
    cast = np.linalg.norm(colours.measured[greys, 1:] - colours.wanted[greys, 1:], axis=1)
    rows = [
        _row("colour", "ΔE2000, mean over patches", float(np.mean(colours.difference)), "ΔE2000"),
        _row("worst", "ΔE2000, worst patch", float(np.max(colours.difference)), "ΔE2000"),
        _row("tone", "tone, worst grey", float(np.abs(tone).max()), "ΔL*"),
        _row("white", "white balance, worst grey", float(cast.max()), "Δ(a*, b*)"),
    ]
    if uniformity is not None:
        rows.append(
            IndicatorRow(
                "uniformity of the light, least over greatest", 100 * uniformity, "%", "–", "–"
            )
        )
    return rows


def _row(key: str, name: str, value: float, unit: str) -> IndicatorRow:
    stars, levels = LEVELS[key]
    reached = [f"{4 - i} stars" for i, most in enumerate(stars) if value < most]
    level = [f"level {'ABC'[i]}" for i, most in enumerate(levels) if value <= most]
    fadgi = "–" if not stars else (reached[0].replace("1 stars", "1 star") if reached else "none")
    return IndicatorRow(name, value, unit, fadgi, level[0] if level else "none")
