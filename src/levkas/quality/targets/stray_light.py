"""Stray light, as the grey patches of a chart show it: what lens, camera body and room add to every patch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.core.cube import Band
    from levkas.quality.targets.charts import Chart, ChartReference

OF_A_CHART = 0.02
"""How far a patch of one chart lies from the published spectrum, relative: an assumption. Half or twice of it makes the
standard error 0.16 or 0.25 % of the white, instead of 0.19."""
OF_BLACK = 0.002
"""The same in reflectance, of the black patch, whose gloss depends on the lighting. Half or twice: 0.12 or 0.32 %."""
LEAST = 0.005
"""Share of the white from which stray light is named: below, one chart's black cannot be distinguished from another's."""


class StrayLight(NamedTuple):
    """Light beside what patches reflect, as a share of the white's, by band, with its standard error; NaN where unknown."""

    shares: np.ndarray
    errors: np.ndarray

    @property
    def worst(self) -> int | None:
        """The band with the largest share that is beyond chance and `LEAST`; None without one."""
        certain = np.abs(self.shares) > np.maximum(LEAST, 2 * self.errors)
        if not certain.any():
            return None
        return int(np.argmax(np.where(certain, np.abs(self.shares), -1)))

    def to_dict(self, bands: Sequence[Band]) -> list[dict[str, Any]]:
        """Return the record for `--json`."""
        return [
            {"band": band.label, "share": float(f"{share:.3g}"), "error": float(f"{error:.2g}")}
            for band, share, error in zip(bands, *self, strict=True)
            if np.isfinite(share)
        ]


def measure_stray_light(
    means: np.ndarray, wavelengths: np.ndarray, chart: Chart, reference: ChartReference
) -> StrayLight:
    """Measure stray light from the grey patches of a chart.

    Parameters
    ----------
    means : ndarray, (patches, bands)
        Reflectance as measured.
    wavelengths : ndarray, (bands,), nm
        NaN for a broad channel: greys hardly change over wavelength, and their mean is taken.
    chart : Chart
    reference : ChartReference

    Returns
    -------
    stray : StrayLight
        Light of a share s of the white's that lies on all patches makes of a reflectance r (r + s) / (1 + s') with
        some s' for the white: a straight line, of which s is where it meets r = 0. A dark that is too dark does the
        same. The line is fitted by least squares to the greys, whose published spectra are as uncertain as
        `OF_A_CHART` and `OF_BLACK` say.

    Notes
    -----
    ISO 18844:2017 measures flare so, by black patches in a bright field; a chart shows that of its own surrounds
    alone.

    Examples
    --------
    >>> from levkas.quality.targets.charts import chart_of, reference_of
    >>> chart = chart_of("ColorChecker24")
    >>> spectra = reference_of(chart)
    >>> measured = 0.98 * spectra.at(np.array([550.0])) + 0.02
    >>> stray = measure_stray_light(measured, np.array([550.0]), chart, spectra)
    >>> stray.shares.round(3).tolist(), stray.errors.round(4).tolist(), stray.worst
    ([0.02], [0.0019], 0)
    """
    greys = list(chart.greys)
    visible = reference.wavelengths[(reference.wavelengths > 420) & (reference.wavelengths < 680)]
    known = reference.at(wavelengths)[greys]
    flat = reference.at(visible)[greys].mean(1) if len(visible) else np.full(len(greys), np.nan)
    known = np.where(np.isfinite(wavelengths), known, flat[:, None])
    shares, errors = np.full((2, len(wavelengths)), np.nan)
    for band in range(len(wavelengths)):
        published, measured = known[:, band], means[greys, band]
        good = np.isfinite(published) & np.isfinite(measured)
        if good.sum() < 4:
            continue
        weight = 1 / np.hypot(OF_A_CHART * published[good], OF_BLACK)
        rows = np.stack([np.ones(good.sum()), published[good]], 1) * weight[:, None]
        line, *_ = np.linalg.lstsq(rows, measured[good] * weight, rcond=None)
        left = np.sum((rows @ line - measured[good] * weight) ** 2) / (good.sum() - 2)
        shares[band] = line[0]
        errors[band] = np.sqrt(np.linalg.inv(rows.T @ rows)[0, 0] * max(1.0, left))
    return StrayLight(shares, errors)


def describe_stray_light(stray: StrayLight, bands: Sequence[Band]) -> str:
    """Return a sentence on stray light that is certain; empty where none is."""
    if (worst := stray.worst) is None:
        return ""
    share, error = stray.shares[worst], stray.errors[worst]
    return (
        f"the greys are {'lifted' if share > 0 else 'lowered'} by {abs(share):.1%} ± {error:.1%} of the white in "
        f"{bands[worst].label}: {STRAY if share > 0 else TOO_DARK}. Sigma does not contain it"
    )


STRAY = (
    "stray light of lens or room lies on all that this camera captured, or its darks are too dark; shade the lens, darken "
    "the room, and check the darks and `black`"
)
TOO_DARK = "the darks are brighter than the black of these captures; check them and `black`"
NOT_MEASURED = "stray light was not measured, and sigma does not contain it: capture a colour chart, and name it in `targets.charts`"
