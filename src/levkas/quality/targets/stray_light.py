"""Stray light, as the grey patches of a chart or a light trap show it: what lens, camera body and room add to what is dark."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.core.cube import Cube, Flag, is_flagged

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from levkas.core.cube import Band
    from levkas.quality.targets.charts import Chart, ChartReference

OF_A_CHART = 0.02
"""How far a patch of one chart lies from the published spectrum, relative: an assumption. Half or twice of it makes the
standard error 0.16 or 0.25 % of the white, instead of 0.19."""
OF_BLACK = 0.002
"""The same in reflectance, of the black patch, whose gloss depends on the lighting. Half or twice: 0.12 or 0.32 %."""
LEAST = 0.005
"""Share of the white from which stray light is named: below, one chart's black cannot be distinguished from another's."""
OF_TRAP = 0.0005
"""Reflectance of a light trap, and how far its darks may be wrong: an assumption. Half or twice of it halves or doubles the error."""
OF_FORM = 0.25
"""How far the share of the view's light errs, relative: it is taken for spread evenly over the view, and real stray light falls off
with the distance, by a quarter to a third more or less beside a trap or a chart."""


class OfView(NamedTuple):
    """The share s of the model y = (1 − s) x + s·x̄, with the mean x̄ of the view, by band with its standard error; NaN where unknown."""

    shares: np.ndarray
    errors: np.ndarray

    def to_dict(self, bands: Sequence[Band]) -> dict[str, Any]:
        """Return the record: the camera's number, the mean of its bands, and those of its bands."""
        known = [i for i, share in enumerate(self.shares) if np.isfinite(share)]
        share, error = self.shares[known].mean(), np.sqrt(np.mean(self.errors[known] ** 2))
        return {
            "share": float(f"{share:.3g}"),
            "error": float(f"{error:.2g}"),
            "bands": {
                bands[i].label: [float(f"{self.shares[i]:.3g}"), float(f"{self.errors[i]:.2g}")]
                for i in known
            },
        }


class StrayLight(NamedTuple):
    """Light beside what patches reflect, as a share of the white's, by band, with its standard error; NaN where unknown.

    `of_view` are the same as a share of the light that is in the view; None where that was not looked at.
    """

    shares: np.ndarray
    errors: np.ndarray
    of_view: OfView | None = None

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
            for band, share, error in zip(bands, self.shares, self.errors, strict=True)
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


def light_of_view(cube: Cube) -> np.ndarray:
    """Return the mean of all that a cube shows, (bands,); NaN of a band without light."""
    lost = is_flagged(cube.flags, Flag.DEFECT | Flag.OUTSIDE) | ~np.isfinite(cube.values)
    count = np.sum(~lost, axis=(0, 1))
    light = np.where(lost, 0.0, cube.values).sum((0, 1), dtype=float) / np.maximum(count, 1)
    return np.where(light > 0, light, np.nan)


def of_view(shares: np.ndarray, errors: np.ndarray, light: np.ndarray) -> OfView | None:
    """Return shares of the white's light as shares of that of the view, (bands,); None where none is known."""
    if not np.isfinite(shares / light).any():
        return None
    return OfView(shares / light, np.hypot(errors, OF_FORM * shares) / light)


def stray_light_of_trap(cube: Cube, boxes: Sequence[tuple[int, int, int, int]]) -> OfView | None:
    """Return the share of the view's light that strays into light traps, which reflect nothing; None where nothing is known of them.

    Parameters
    ----------
    cube : Cube
        Reflectance, native px.
    boxes : sequence of (x, y, width, height), px
        Within the traps.

    Examples
    --------
    >>> from levkas.core.cube import Band
    >>> x = np.full((40, 60, 1), 0.5, np.float32); x[10:30, 20:40] = 0
    >>> y = np.float32(0.98) * x + np.float32(0.02) * x.mean()
    >>> cube = Cube(y, np.zeros(y.shape, np.uint8), None, (Band("R"),), "reflectance")
    >>> found = stray_light_of_trap(cube, [(22, 12, 16, 16)])
    >>> found.shares.round(3).tolist()
    [0.02]
    """
    light = light_of_view(cube)
    lost = is_flagged(cube.flags, Flag.DEFECT | Flag.OUTSIDE)
    values = np.where(lost, np.nan, cube.values)
    shown = np.concatenate(
        [values[y : y + h, x : x + w].reshape(-1, values.shape[2]) for x, y, w, h in boxes]
    )
    known = np.isfinite(shown)
    count = known.sum(0)
    means = np.where(known, shown, 0.0).sum(0, dtype=float) / np.where(count, count, np.nan)
    return of_view(means, np.full(len(means), OF_TRAP), light)


def describe_stray_light(stray: StrayLight, bands: Sequence[Band]) -> str:
    """Return a sentence on stray light that is certain; empty where none is."""
    if (worst := stray.worst) is None:
        return ""
    share, error = stray.shares[worst], stray.errors[worst]
    return (
        f"the greys are {'lifted' if share > 0 else 'lowered'} by {abs(share):.1%} ± {error:.1%} of the white in "
        f"{bands[worst].label}: {STRAY if share > 0 else TOO_DARK}. Sigma does not contain it"
    )


def describe_trap(found: Mapping[str, Any]) -> str:
    """Return a sentence on stray light in a trap, of the record of an `OfView`, that is certain; empty where none is."""
    share, error = found["share"], found["error"]
    if share < max(LEAST, 2 * error):
        return ""
    return f"light traps show {share:.1%} ± {error:.1%} of the light of the view: {STRAY}. Sigma does not contain it"


STRAY = (
    "stray light of lens or room lies on all that this camera captured, or its darks are too dark; shade the lens, darken "
    "the room, and check the darks and `black`"
)
TOO_DARK = "the darks are brighter than the black of these captures; check them and `black`"
NOT_MEASURED = (
    "stray light was not measured, and sigma does not contain it: capture a colour chart, and name it in `targets.charts`, or a "
    "light trap, and name it in `targets.traps`"
)
