"""Stray light, as the grey patches of a chart or a light trap show it: what lens, camera body and room add to what is dark."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.stray_light import spread_light
from levkas.core.cube import Cube, Flag, is_flagged
from levkas.quality.targets.charts import pixels_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

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
DARK = 0.15
"""Patches below it show by their shading how wide stray light is; in brighter ones 0.1 % of uneven light is as much."""
FEW = 5
"""Bands that the width is found in."""
BLOCKS = 256
"""Of the longer side of a view: widths are found in their means."""
WIDTHS = 12
"""That are tried, from three blocks to half the diagonal: 1.5-fold steps."""
OF_FORM = 0.25
"""How far the share errs, relative, as real stray light has other tails than a Gaussian: of exponential and inverse-cube ones a quarter to
a third. Without a width B x is the mean of the view, and nothing of this applies."""
SIGNIFICANT = 9.0
"""Gain in chi square from which a width is known: three standard deviations. Half or twice: 2.1 or 4.2."""


class OfView(NamedTuple):
    """The share s of the model y = (1 − s) x + s·B x, by band with its standard error, and in one number for the camera.

    `width_px` is the standard deviation of the Gaussian B, native px; None where the neighbourhood shows none, and B is
    the mean of the view.
    """

    shares: np.ndarray
    errors: np.ndarray
    share: float
    error: float
    width_px: float | None

    def to_dict(self, bands: Sequence[Band]) -> dict[str, Any]:
        """Return the record: the camera's number, and those of its bands."""
        known = [i for i, share in enumerate(self.shares) if np.isfinite(share)]
        return {
            "share": float(f"{self.share:.3g}"),
            "error": float(f"{self.error:.2g}"),
            "width_px": None if self.width_px is None else float(f"{self.width_px:.2g}"),
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
    means: np.ndarray,
    wavelengths: np.ndarray,
    chart: Chart,
    reference: ChartReference,
    spread: np.ndarray | None = None,
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
    spread : ndarray, (patches, bands), optional
        What stray light shows at each patch, B x: shares are then of that, in place of the white's.

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
        lifted = np.ones(good.sum()) if spread is None else spread[greys, band][good]
        rows = np.stack([lifted, published[good]], 1) * weight[:, None]
        line, *_ = np.linalg.lstsq(rows, measured[good] * weight, rcond=None)
        left = np.sum((rows @ line - measured[good] * weight) ** 2) / (good.sum() - 2)
        shares[band] = line[0]
        errors[band] = np.sqrt(np.linalg.inv(rows.T @ rows)[0, 0] * max(1.0, left))
    return StrayLight(shares, errors)


class View:
    """A picture in blocks, and what stray light of any width shows there.

    Parameters
    ----------
    cube : Cube
        Reflectance in native pixels.
    areas : sequence of ndarray, (4, 2), native px
        Of even reflectance: to what strays they give their mean, for else their own noise would be found in it.
    """

    def __init__(self, cube: Cube, areas: Sequence[np.ndarray]) -> None:
        height, width, self._count = cube.values.shape
        self.side = max(1, -(-max(height, width) // BLOCKS))
        lost = is_flagged(cube.flags, Flag.DEFECT | Flag.OUTSIDE)
        extra = (0, -height % self.side), (0, -width % self.side)
        self._planes = []
        for band in range(self._count):
            plane = np.where(lost[..., band], np.nan, cube.values[..., band])
            wide = np.pad(plane, extra, constant_values=np.nan)
            shape = wide.shape[0] // self.side, self.side, wide.shape[1] // self.side, self.side
            blocks, known = wide.reshape(shape), np.isfinite(wide).reshape(shape)
            sums, counts = np.where(known, blocks, 0.0).sum((1, 3)), known.sum((1, 3))
            full = np.full(sums.shape, np.nan)
            self._planes.append(np.divide(sums, counts, out=full, where=counts > 0))
        self.areas = [self._inside(area) for area in areas]
        self._even = [plane.copy() for plane in self._planes]
        for plane in self._even:
            for at in self.areas:
                if np.isfinite(plane[at]).any():
                    plane[at] = np.nanmean(plane[at])

    def _inside(self, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (rows, columns) of the blocks whose centres lie in an area, (4, 2) native px."""
        rows, columns = pixels_of((area + 0.5) / self.side - 0.5)
        tall, wide = self._planes[0].shape
        good = (rows >= 0) & (rows < tall) & (columns >= 0) & (columns < wide)
        return rows[good], columns[good]

    def few(self, usable: np.ndarray) -> list[int]:
        """Return some of the usable bands, evenly over all."""
        at = np.flatnonzero(usable)
        return at[np.unique(np.linspace(0, len(at) - 1, min(FEW, len(at))).astype(int))].tolist()

    def widths(self) -> list[float | None]:
        """Return the widths that are tried, native px; None for the mean of the view, the last."""
        most = float(np.hypot(*self._planes[0].shape)) / 2
        return [float(w) * self.side for w in np.geomspace(3.0, max(most, 6.0), WIDTHS)] + [None]

    def spread(self, band: int, width_px: float | None) -> np.ndarray:
        """Return B x of a band, in blocks."""
        narrow = None if width_px is None else width_px / self.side
        return spread_light(self._even[band], narrow)

    def plane(self, band: int) -> np.ndarray:
        """Return a band in blocks."""
        return self._planes[band]


Blocks = tuple[np.ndarray, np.ndarray]


def join_of_view(found: Sequence[OfView | None], bands: Sequence[int]) -> OfView | None:
    """Return what several sensors of a camera show as one; `bands` are how many each has, None is of one that shows nothing."""
    known = [one for one in found if one is not None]
    if not known:
        return None
    shares, errors = (
        np.concatenate(
            [
                np.full(count, np.nan) if one is None else getattr(one, part)
                for one, count in zip(found, bands, strict=True)
            ]
        )
        for part in ("shares", "errors")
    )
    share, error = (float(np.mean([getattr(one, n) for one in known])) for n in ("share", "error"))
    widths = [one.width_px for one in known if one.width_px is not None]
    width = float(np.median(widths)) if 2 * len(widths) > len(known) else None
    return OfView(shares, errors, share, error, width)


def stray_light_of_chart(
    cube: Cube, areas: np.ndarray, means: np.ndarray, chart: Chart, reference: ChartReference
) -> OfView | None:
    """Return the share of the view's light that strays on to the patches of a chart; None where no band's patches are published.

    Parameters
    ----------
    cube : Cube
        Reflectance, native px.
    areas : ndarray, (patches, 4, 2), px
    means : ndarray, (patches, bands)
        NaN in bands that are to be left out.
    chart : Chart
    reference : ChartReference

    Notes
    -----
    The share follows from the levels of the greys; the width from the shading of dark patches, whatever these reflect.
    """
    view = View(cube, [*areas])
    wavelengths, patches = np.array([band.wavelength for band in cube.bands], float), view.areas

    def levels(width_px: float | None, bands: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        spread = np.full(means.shape, np.nan)
        for band in bands:
            plane = view.spread(band, width_px)
            spread[:, band] = [plane[at].mean() if len(at[0]) else np.nan for at in patches]
        picked = np.where(np.isfinite(spread), means, np.nan)
        found = measure_stray_light(picked, wavelengths, chart, reference, spread)
        return found.shares, found.errors

    dark = {band: [at for at, m in zip(patches, means[:, band], strict=True) if m < DARK]
            for band in range(means.shape[1])}  # fmt: skip
    return _fit(view, levels, dark, np.isfinite(means).any(0))


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
    >>> round(found.share, 3), found.width_px
    (0.02, None)
    """
    corners = [
        np.array([(x, y), (x + w - 1, y), (x + w - 1, y + h - 1), (x, y + h - 1)], float)
        for x, y, w, h in boxes
    ]
    view = View(cube, corners)
    places = [at for at in view.areas if len(at[0])]

    def levels(width_px: float | None, bands: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        shares, errors = np.full((2, cube.values.shape[2]), np.nan)
        for band in bands:
            plane, spread = view.plane(band), view.spread(band, width_px)
            shown, light = (np.concatenate([p[at] for at in places]) for p in (plane, spread))
            good = np.isfinite(shown)
            if good.any() and light[good].mean() > 0:
                shares[band] = shown[good].mean() / light[good].mean()
                errors[band] = OF_TRAP / light[good].mean()
        return shares, errors

    usable = np.array(
        [any(np.isfinite(view.plane(b)[at]).any() for at in places) for b in range(len(cube.bands))]
    )
    return _fit(view, levels, dict.fromkeys(range(len(cube.bands)), places), usable)


def _fit(
    view: View,
    levels: Callable[[float | None, Sequence[int]], tuple[np.ndarray, np.ndarray]],
    dark: dict[int, list[Blocks]],
    usable: np.ndarray,
) -> OfView | None:
    """Return share and width that fit the levels of dark areas and the shading within them, in a few bands; then the shares of all.

    `levels` are shares and errors, (bands,), of a width; `dark` the areas of each band.
    """
    few = view.few(usable)
    tried: list[WidthFit] = []
    for width in view.widths():
        shares, errors = levels(width, few)
        known = [band for band in few if np.isfinite(shares[band])]
        if not known:
            return None
        # The paint of a chart errs alike in all bands.
        level, error = float(np.mean(shares[known])), float(np.sqrt(np.mean(errors[known] ** 2)))
        shading = _shading(view, {band: dark[band] for band in known}, width)
        tried.append(WidthFit(width, level, error, *shading))
    best = min(tried, key=lambda fit: fit.misfit)
    scale = max(
        1.0, best.misfit / max(best.points, 1)
    )  # texture and uneven light are more than noise
    if tried[-1].misfit - best.misfit < SIGNIFICANT * scale:
        best = tried[-1]
    share, variance = best.share_and_variance(scale)
    error = float(np.sqrt(variance))
    shares, errors = levels(best.width_px, np.flatnonzero(usable).tolist())
    if best.width_px is not None:  # the shading of all bands tells more than the level of one
        own = errors**2 + (OF_FORM * shares) ** 2
        weight = error**2 / (own + error**2)
        shares, errors = weight * shares + (1 - weight) * share, np.sqrt(weight * own)
    return OfView(shares, errors, share, error, best.width_px)


class WidthFit(NamedTuple):
    """How one width fits: what the levels of dark areas give for the share, and the sums of `_shading`."""

    width_px: float | None
    level: float
    error: float
    slope: float
    match: float
    rest: float
    points: int

    @property
    def misfit(self) -> float:
        """Chi square of levels and shading, at the share that fits both best."""
        share = (self.match + self.level / self.error**2) / (self.slope + self.error**-2)
        shading = self.rest - 2 * share * self.match + share**2 * self.slope
        return shading + ((share - self.level) / self.error) ** 2

    def share_and_variance(self, scale: float) -> tuple[float, float]:
        """Return the share by levels and shading, each as far as it may err by the form of the blur."""
        if self.width_px is None or self.slope <= 0:
            return self.level, self.error**2
        shaded = self.match / self.slope
        form = OF_FORM * max(abs(self.level), abs(shaded))
        variances = self.error**2 + form**2, scale / self.slope + form**2
        weight = variances[1] / sum(variances)
        share = weight * self.level + (1 - weight) * shaded
        return share, weight * variances[0]


def _shading(
    view: View, dark: dict[int, list[Blocks]], width_px: float | None
) -> tuple[float, float, float, int]:
    """Return Σ b², Σ v·b and Σ v² over noise, and how many, of values v and of what stray light shows, b, both about the mean of each area."""
    slope = match = rest = 0.0
    count = 0
    for band, areas in dark.items():
        plane, spread = view.plane(band), view.spread(band, width_px)
        for at in areas:
            shown, light = plane[at], spread[at]
            good = np.isfinite(shown)
            if good.sum() < 8:
                continue
            y, x = (part[good] - part[good].mean() for part in at)
            v, b = (part[good] - part[good].mean() for part in (shown, light))
            rows = np.stack([x, y, x * x - np.mean(x * x), y * y - np.mean(y * y), x * y], 1)
            smooth, *_ = np.linalg.lstsq(rows, v, rcond=None)
            noise = max(float(np.mean((v - rows @ smooth) ** 2)), 1e-12)
            # Another form of the blur errs alike in all blocks and bands.
            shaded = max(float(np.mean(v**2)) - noise, 0.0)
            noise += len(v) * len(dark) * OF_FORM**2 * shaded
            slope, match = slope + float(b @ b) / noise, match + float(v @ b) / noise
            rest, count = rest + float(v @ v) / noise, count + len(v)
    return slope, match, rest, count


def describe_stray_light(stray: StrayLight, bands: Sequence[Band]) -> str:
    """Return a sentence on stray light that is certain; empty where none is."""
    if (worst := stray.worst) is None:
        return ""
    share, error = stray.shares[worst], stray.errors[worst]
    return (
        f"the greys are {'lifted' if share > 0 else 'lowered'} by {abs(share):.1%} ± {error:.1%} of the white in "
        f"{bands[worst].label}: {STRAY if share > 0 else TOO_DARK}. Sigma does not contain it"
        f"{_remedy(*stray.of_view[2:]) if share > 0 and stray.of_view else ''}"
    )


def describe_trap(found: Mapping[str, Any]) -> str:
    """Return a sentence on stray light in a trap, of the record of an `OfView`, that is certain; empty where none is."""
    share, error = found["share"], found["error"]
    if share < max(LEAST, 2 * error):
        return ""
    return (
        f"light traps show {share:.1%} ± {error:.1%} of the light of the view: {STRAY}. Sigma does not contain it"
        f"{_remedy(share, error, found['width_px'])}"
    )


def _remedy(share: float, error: float, width_px: float | None) -> str:
    """Return what corrects stray light, where it is certain enough to be corrected."""
    if share < 2 * error:
        return ""
    width = "" if width_px is None else f", width_px = {width_px:.2g}"
    return f"; `stray_light = {{ share = {share:.2g}{width} }}` of the camera corrects it"


STRAY = (
    "stray light of lens or room lies on all that this camera captured, or its darks are too dark; shade the lens, darken "
    "the room, and check the darks and `black`"
)
TOO_DARK = "the darks are brighter than the black of these captures; check them and `black`"
NOT_MEASURED = (
    "stray light was not measured, and sigma does not contain it: capture a colour chart, and name it in `targets.charts`, or a "
    "light trap, and name it in `targets.traps`"
)
