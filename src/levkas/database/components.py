"""Components of a layer, found in two passes over blocks of rows: principal components, minimum-noise fractions.

Both are weighted sums of the bands. Principal components are ordered by variance [hotelling1933]_, minimum-noise
fractions by the variance of the signal over that of the noise [green1988]_: the eigenvectors of Σ v = λ N v, with
the covariance Σ of the values and N of their noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import xarray

from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.core.text import counted
from levkas.database.regions import TRUSTED

Method = Literal["pca", "mnf"]
BLOCK_SAMPLES = 4_000_000
"""Read at a time; sums of linear algebra depend on it, so that it is the same on every machine."""
MORE_PIXELS = 10
"""Sound pixels a band, at least: of fewer, chance alone makes components."""
LEAST_NOISE = 1e-12
"""Of the variance of a band, times: below it a band has no noise that could be divided by."""


class ComponentsRefused(Refused):
    """A layer has no components: too few bands or sound pixels, or no noise to compare with."""


@dataclass(frozen=True, eq=False)
class Components:
    """Components of one layer.

    Parameters
    ----------
    method : "pca" or "mnf"
    bands : tuple of str
    mean : ndarray, (bands,)
        Of the sound pixels, in the unit of the values.
    loadings : ndarray, (components, bands)
        Weights of the bands, the first component first. Of principal components they have length 1; of
        minimum-noise fractions they make the noise of a component 1. The largest of each is positive.
    variance : ndarray, (components,)
        Of the sound pixels in each component.
    explained : ndarray, (components,)
        Share of each in the sum of all variances.
    noise : ndarray, (bands, bands), or None
        Covariance of the noise; of minimum-noise fractions.
    noise_from : str
        ``"sigma"`` or ``"differences"`` of neighbouring pixels; empty of principal components.
    pixels : int
        Sound pixels behind them.
    """

    method: Method
    bands: tuple[str, ...]
    mean: np.ndarray
    loadings: np.ndarray
    variance: np.ndarray
    explained: np.ndarray
    noise: np.ndarray | None
    noise_from: str
    pixels: int

    @property
    def snr(self) -> np.ndarray | None:
        """Variance of the signal over that of the noise of each minimum-noise fraction, (components,)."""
        return None if self.noise is None else np.maximum(self.variance - 1.0, 0.0)

    def rows(
        self, layer: xarray.DataArray, flags: xarray.DataArray, *, count: int
    ) -> Iterator[np.ndarray]:
        """Yield the first components of a layer, (rows, x, count) float32 from top to bottom; NaN of unsound pixels."""
        for values, sound, _ in _blocks(layer, flags, None):
            with steady_libraries():
                scores = (np.where(sound[..., None], values, 0.0) - self.mean) @ self.loadings[
                    :count
                ].T
            scores[~sound] = np.nan
            yield scores.astype(np.float32)


def find_components(
    layer: xarray.DataArray,
    flags: xarray.DataArray,
    sigma: xarray.DataArray | None = None,
    *,
    method: Method = "pca",
) -> Components:
    """Find the components of a layer.

    Parameters
    ----------
    layer, flags : DataArray, (y, x, band)
        Read some rows at a time. A pixel counts where every band has a value and none has a flag that makes
        it unusable.
    sigma : DataArray, (y, x, band), optional
        One standard deviation of the noise of each value, independent from band to band. Without it the noise of
        minimum-noise fractions is half the covariance of the differences between a pixel and its neighbours to the
        right and below, which takes fine detail for noise, and smooth noise of resampled layers for signal.
    method : "pca" or "mnf"

    Returns
    -------
    components : Components
        The same for any number of threads.

    Raises
    ------
    ComponentsRefused
        ``E_SIZE`` with fewer than 2 bands, or 10 sound pixels a band; ``E_VALUE`` where the noise of a band is nil,
        or there is no such method.

    Examples
    --------
    Two bands that rise together by 1 and by 2: one component, along (1, 2)/√5, of variance 10/3 over 4 pixels.

    >>> steps = np.array([-1.0, 0.0, 1.0, 0.0]).repeat(10)
    >>> cube = xarray.DataArray(np.stack([steps, 2 * steps], -1)[None], dims=("y", "x", "band"),
    ...                         coords={"band": ["a", "b"]})
    >>> found = find_components(cube, xarray.zeros_like(cube, np.uint8))
    >>> found.loadings[0].round(3).tolist(), found.explained.round(3).tolist()
    ([0.447, 0.894], [1.0, 0.0])
    """
    if method not in get_args(Method):
        what = "there is no such method of components"
        raise ComponentsRefused(unknown_name(what, str(method), get_args(Method), field="method"))
    bands = tuple(str(label) for label in layer["band"].values)
    count, mean = _mean(layer, flags)
    if len(bands) < 2 or count < MORE_PIXELS * len(bands):
        raise ComponentsRefused(
            Problem(
                "E_SIZE",
                "too few pixels or bands for components",
                found=f"{count} valid pixels of {counted(len(bands), 'band')}",
                expected=f"2 or more bands, {MORE_PIXELS} valid pixels per band",
            )
        )
    known = sigma if method == "mnf" else None
    covariance, noise, source = _covariances(layer, flags, known, mean, count)
    if method == "pca":
        with steady_libraries():
            variance, vectors = np.linalg.eigh(covariance)
        noise_found, source = None, ""
        share = _shares(variance)
    else:
        noise_found = noise
        variance, vectors = _fractions(covariance, noise, bands)
        share = _shares(variance)
    order = np.argsort(-variance, kind="stable")
    loadings = vectors.T[order]
    signs = np.sign(np.take_along_axis(loadings, np.abs(loadings).argmax(1)[:, None], axis=1))
    return Components(
        *(method, bands, mean, loadings * signs, np.maximum(variance[order], 0.0), share[order]),
        *(noise_found, source, count),
    )


def _fractions(
    covariance: np.ndarray, noise: np.ndarray, bands: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Solve Σ v = λ N v, vᵀ N v = 1."""
    from scipy.linalg import LinAlgError, eigh

    silent = np.flatnonzero(~(np.diag(noise) > LEAST_NOISE * np.diag(covariance)))
    try:
        if not silent.size:
            with steady_libraries():
                values, vectors = eigh(covariance, noise)
            return np.asarray(values), np.asarray(vectors)
    except LinAlgError:
        pass
    raise ComponentsRefused(
        Problem(
            "E_VALUE",
            "the noise is zero, so signal and noise cannot be compared",
            found=f"no noise in {bands[silent[0]]}"
            if silent.size
            else "bands that are sums of others",
            expected="independent noise in every band",
        )
    )


def _shares(variance: np.ndarray) -> np.ndarray:
    total = np.maximum(variance, 0.0)
    return np.asarray(total / max(float(total.sum()), 1e-300))


def _blocks(
    layer: xarray.DataArray, flags: xarray.DataArray, sigma: xarray.DataArray | None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """Yield values float64 (rows, x, band), which pixels are sound (rows, x), and sigma, from top to bottom."""
    height, width, bands = (layer.sizes[dim] for dim in ("y", "x", "band"))
    step = max(1, BLOCK_SAMPLES // max(1, width * bands))
    for top in range(0, height, step):
        part = {"y": slice(top, top + step)}
        values = layer.isel(part).values.astype(np.float64)
        marks = flags.isel(part).values & ~TRUSTED
        sound = np.asarray(np.isfinite(values).all(-1) & ~marks.any(-1))
        yield values, sound, None if sigma is None else sigma.isel(part).values


def _mean(layer: xarray.DataArray, flags: xarray.DataArray) -> tuple[int, np.ndarray]:
    count, total = 0, np.zeros(layer.sizes["band"])
    for values, sound, _ in _blocks(layer, flags, None):
        total += values[sound].sum(0)
        count += int(sound.sum())
    return count, total / max(count, 1)


def _covariances(
    layer: xarray.DataArray,
    flags: xarray.DataArray,
    sigma: xarray.DataArray | None,
    mean: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray, str]:
    """Covariance of sound pixels and of their noise, and what the noise is from."""
    bands = len(mean)
    products, noise = np.zeros((bands, bands)), np.zeros((bands, bands))
    pairs, known = 0, 0
    above: tuple[np.ndarray, np.ndarray] | None = None
    for values, sound, spread in _blocks(layer, flags, sigma):
        with steady_libraries():
            centred = values[sound] - mean
            products += centred.T @ centred
            if spread is not None:
                squares = np.square(spread[sound].astype(np.float64))
                finite = np.isfinite(squares).all(1)
                noise += np.diag(squares[finite].sum(0))
                known += int(finite.sum())
                continue
            if above is not None:
                values, sound = (
                    np.concatenate(two) for two in zip(above, (values, sound), strict=True)
                )
            first = 0 if above is None else 1
            across = sound[first:, 1:] & sound[first:, :-1]
            down = sound[1:] & sound[:-1]
            for one, other, both in (
                (values[first:, 1:], values[first:, :-1], across),
                (values[1:], values[:-1], down),
            ):
                apart = one[both] - other[both]
                noise += apart.T @ apart / 2
                pairs += len(apart)
            above = values[-1:], sound[-1:]
    total = products / max(count - 1, 1)
    if sigma is not None and known:
        return total, noise / known, "sigma"
    return total, noise / max(pairs, 1), "differences"
