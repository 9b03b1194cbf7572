"""How sure estimated spectra are: errors of the responses through an estimator, of its training, and of its prediction.

    ŷ − y = J δx + δf + ε

J is the slope of the estimator, δx the errors of the responses, with what they have in common ([jcgm2008]_, Eq. 13). δf is what the
training had: an estimator fitted to spectra of a wrong white gives spectra of that white, and one fitted to responses of a wrong
scale undoes that scale where the same camera is applied. ε is what responses do not tell of a paint, as paintings that were held out
show it: common to all pixels of one paint, so that the mean of many is no better known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.error_sources import ErrorSource, MeanSpectrum, Part, uncertain_mean
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import read_budget

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from levkas.estimation.model import Model

PREDICTION, NOISE = "prediction", "noise"
STEP = 0.005
"""Reflectance by which responses are changed to find slopes: about their errors; half and twice it move U by less than 1 %."""
SAMPLES = 100
"""Pixels at which slopes are taken; their mean is known to a tenth of their scatter."""
APART_PX, LEAST_PAIRS = 4, 100
"""How far pixels lie apart, px, that were interpolated from no common ones; and fewest pairs, by which an error is known to a tenth."""
PATTERNS, LEFT = 6, 0.02
"""Patterns over the bands of what a prediction misses: as many as leave this share of its variance, and no more than six."""


@dataclass(frozen=True, eq=False)
class PredictionError:
    """What an estimator misses of paints that it was not fitted to.

    Parameters
    ----------
    patterns : ndarray, (k, bands)
        Of which each error is a sum, with independent coefficients of variance 1.
    rest : ndarray, (bands,)
        Standard deviation of what each band has beyond them.
    alone : ndarray, (bands,)
        Of what single pixels are missed by beyond that and beyond the noise of their responses.
    """

    patterns: np.ndarray
    rest: np.ndarray
    alone: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of each band that the pixels of a paint have in common, (bands,)."""
        return np.sqrt(np.square(self.patterns).sum(0) + np.square(self.rest))

    @classmethod
    def measure(
        cls,
        residuals: np.ndarray,
        noise: np.ndarray | float = 0.0,
        pairs: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> PredictionError:
        """Describe held-out errors by patterns.

        Parameters
        ----------
        residuals : ndarray, (n, bands)
            Estimated − measured.
        noise : ndarray, (bands, bands), or float
            Covariance by noise of the measured spectra and of the responses, which is not the estimator's.
        pairs : tuple of ndarray, (m,) and (m,), int, optional
            Pixels that lie near one another and have no noise in common: what both are missed by is measured, whatever the noise is.
            Without it, or of fewer than `LEAST_PAIRS`, noise is taken off.

        Examples
        --------
        >>> found = PredictionError.measure(np.array([[0.03, 0.06], [-0.03, -0.06]]))
        >>> found.patterns.round(3).tolist(), found.sigma.round(3).tolist()
        ([[0.03, 0.06]], [0.03, 0.06])
        """
        whole = residuals.T @ residuals / len(residuals) - noise
        moment = whole
        if pairs is not None and len(pairs[0]) >= LEAST_PAIRS:
            moment = residuals[pairs[0]].T @ residuals[pairs[1]] / len(pairs[0])
            moment = (moment + moment.T) / 2
        values, vectors = np.linalg.eigh(moment)
        order = np.argsort(-values, kind="stable")
        values, vectors = np.maximum(values[order], 0), vectors[:, order]
        part = np.cumsum(values) / max(float(values.sum()), 1e-300)
        count = min(PATTERNS, 1 + int(np.searchsorted(part, 1 - LEFT)), len(values))
        signs = np.where(vectors.sum(0) < 0, -1.0, 1.0)
        patterns = (vectors * signs * np.sqrt(values)).T
        alone = np.diag(whole) - np.square(patterns).sum(0)
        rest = np.sqrt(np.square(patterns[count:]).sum(0))
        return cls(patterns[:count], rest, np.sqrt(np.maximum(alone, 0)))

    def to_dict(self) -> dict[str, Any]:
        """Return it, JSON-ready."""
        return {name: getattr(self, name).tolist() for name in ("patterns", "rest", "alone")}


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """What all estimates of a fitted model have in common.

    Parameters
    ----------
    training : tuple of ErrorSource
        Of the spectra that it was fitted to, and of single captures of its training.
    cameras : tuple of ErrorSource
        Of the cameras whose responses it was fitted to, in bands of the spectra: the same cameras undo them.
    """

    prediction: PredictionError
    training: tuple[ErrorSource, ...] = ()
    cameras: tuple[ErrorSource, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return them, JSON-ready."""
        rows = {name: [row.to_dict() for row in getattr(self, name)] for name in ("training", "cameras")}  # fmt: skip
        return {"prediction": self.prediction.to_dict(), **rows}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any], bands: int) -> ModelErrors:
        """Read what `to_dict` gave; raises KeyError, TypeError or ValueError where it is none of so many bands."""
        prediction = record["prediction"]
        patterns = np.array(prediction["patterns"], float).reshape(-1, bands)
        others = (np.array(prediction[name], float).reshape(bands) for name in ("rest", "alone"))
        rows = (
            tuple(ErrorSource.from_dict(row) for row in record[name])
            for name in ("training", "cameras")
        )
        return cls(PredictionError(patterns, *others), *rows)


class Channels(NamedTuple):
    """One layer's channels among the responses: its bands, and what makes their values uncertain."""

    layer: str
    camera: str
    labels: Sequence[str]
    wavelengths: np.ndarray
    rows: tuple[ErrorSource, ...]


def channels_of(opened: xarray.DataArray, layer: str, rows: Iterable[ErrorSource]) -> Channels:
    """Describe the channels of an opened layer."""
    labels = [str(label) for label in opened.band.values]
    wavelengths = np.asarray(opened.wavelength.values, float)
    return Channels(layer, LayerId.parse("", layer).camera, labels, wavelengths, tuple(rows))


def slopes_of(model: Model, responses: np.ndarray) -> np.ndarray:
    """Return the slope of estimated spectra with responses, (n, channels) → (n, bands, channels)."""
    n, channels = responses.shape
    steps = STEP * np.eye(channels)
    up, down = (
        model((responses[:, None] + step).reshape(-1, channels))[0].reshape(n, channels, -1)
        for step in (steps, -steps)
    )
    return np.asarray((up - down).transpose(0, 2, 1) / (2 * STEP))


def carry_on(
    model: Model, responses: np.ndarray, channels: Sequence[Channels], labels: Sequence[str]
) -> list[ErrorSource]:
    """Return rows of the channels' budgets as rows of estimated spectra, one for every draw of an error, by slopes at responses, (n, channels).

    Notes
    -----
    A row is relative or absolute, whichever is nearer to what the error does to the pixels, by least squares.
    """
    moves: dict[Part, np.ndarray] = {}
    of_part: dict[Part, ErrorSource] = {}
    start = 0
    for one in channels:
        here = slice(start, start + len(one.labels))
        start = here.stop
        for row in one.rows:
            if row.unit in ("px", "sigma") or row.common_to in ("pixel", "line") or not row.size:
                continue
            for i, values in enumerate(responses[:, here]):
                mean = MeanSpectrum(one.labels, values, np.zeros(len(values)), one.wavelengths)
                made = uncertain_mean(mean, [row], layer=one.layer, camera=one.camera)
                for part, move in made.parts.items():
                    moves.setdefault(part, np.zeros(responses.shape))[i, here] += move
                    of_part[part] = row
    slopes, spectra = slopes_of(model, responses), model(responses)[0]
    return [
        _row_of(of_part[part], part, np.einsum("nbc,nc->nb", slopes, move), spectra, labels)
        for part, move in moves.items()
    ]


def _row_of(
    source: ErrorSource, part: Part, moved: np.ndarray, spectra: np.ndarray, labels: Sequence[str]
) -> ErrorSource:
    """Return by how much one error moves estimated spectra, (n, bands) both, as a row."""
    square = np.maximum(np.square(spectra).sum(0), 1e-12)
    relative, absolute = (moved * spectra).sum(0) / square, moved.mean(0)
    nearer = np.square(moved - relative * spectra).sum() <= np.square(moved - absolute).sum()
    size = dict(zip(labels, (relative if nearer else absolute).tolist(), strict=True))
    name, owner, draw = part
    words = (owner, *(draw if isinstance(draw, tuple) else (draw,)))
    return ErrorSource(
        name,
        "relative" if nearer else "reflectance",
        size,
        source.common_to,
        all_bands=True,
        basis=source.basis,
        owner=" ".join(str(word) for word in words if word not in ("", 0)),
    )


def training_rows(root: Path, names: Sequence[str], layer: str) -> list[ErrorSource]:
    """Return what the captures of several paintings by one camera have in their budgets, as it stays in a fit to all of them.

    What is a single capture's own becomes smaller by the root of their number; noise of pixels is none of it.
    """
    found: dict[tuple[Any, ...], list[ErrorSource]] = {}
    camera = LayerId.parse(names[0], layer).camera
    for name in names:
        for row in read_budget(root, LayerId.parse(name, layer)).sources:
            if row.common_to not in ("pixel", "line", "region"):
                key = row.name, row.unit, row.common_to, row.all_bands, row.owner
                found.setdefault(key, []).append(row)
    rows = []
    for several in found.values():
        first, known = several[0], [row for row in several if row.size]
        if not known:
            rows.append(first)
            continue
        of_frame = first.common_to == "frame"
        count = len(names) ** 2 if of_frame else len(known)
        size = {
            band: float(np.sqrt(sum(row.size.get(band, 0.0) ** 2 for row in known) / count))
            for band in known[0].size
        }
        owner = first.owner or {"frame": f"training on {layer}", "camera": f":{camera}"}.get(first.common_to, "")  # fmt: skip
        extent = "camera" if of_frame else first.common_to
        rows.append(replace(known[0], size=size, owner=owner, common_to=extent))
    return rows


@dataclass(frozen=True, eq=False)
class Estimate:
    """Some pixels of a painting and a model of their spectra.

    Parameters
    ----------
    responses : ndarray, (n, channels)
    noise : ndarray, (n, channels), or None
        Standard deviation of the responses.
    labels : sequence of str
        Of the estimated bands.
    """

    model: Model
    errors: ModelErrors
    responses: np.ndarray
    noise: np.ndarray | None
    channels: Sequence[Channels]
    labels: Sequence[str]
    slopes: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "slopes", slopes_of(self.model, self.responses))

    @property
    def gains(self) -> np.ndarray:
        """Mean squared slope, (channels, bands): variance of an estimate by that of the responses."""
        return np.asarray(np.square(self.slopes).mean(0).T)

    def sigma(self, noise: np.ndarray | None) -> np.ndarray:
        """Return sigma of estimates whose method has none of its own, of responses with noise (m, channels), (m, bands)."""
        prediction = self.errors.prediction
        variance = (np.square(prediction.sigma) + np.square(prediction.alone))[None]
        return np.sqrt(variance if noise is None else variance + np.square(noise) @ self.gains)

    def rows(self, *, same_cameras: bool) -> tuple[ErrorSource, ...]:
        """Return the budget of the estimated spectra.

        Parameters
        ----------
        same_cameras : bool
            Whether the model was fitted to the same cameras, calibrated together: their common errors are undone then.
        """
        undone = ("camera", "campaign") if same_cameras else ()
        here = [
            one._replace(rows=tuple(row for row in one.rows if row.common_to not in undone))
            for one in self.channels
        ]
        known = carry_on(self.model, self.responses, here, self.labels)
        if not same_cameras:
            known += self.errors.cameras
        unknown = {
            row.name: row
            for row in (*(r for one in here for r in one.rows), *self.errors.training)
            if row.basis == "unknown"
        }
        inherited = [row for row in self.errors.training if row.size]
        return (*self._shares(), *known, *inherited, *(replace(row, size={}) for row in unknown.values()))  # fmt: skip

    def _shares(self) -> Iterable[ErrorSource]:
        """Yield which parts of the published sigma bands share: noise by every channel, and the prediction of a paint.

        Of a method with a sigma of its own they are those of its held-out errors and of noise.
        """
        prediction = self.errors.prediction
        level = np.sqrt(np.maximum(np.square(self.sigma(self.noise)).mean(0), 1e-24))
        if self.noise is not None:
            each = (self.slopes * self.noise[:, None]).mean(0).T
            names = [f"{one.layer} {label}" for one in self.channels for label in one.labels]
            for name, moved in zip(names, each, strict=True):
                yield self._share(NOISE, moved / level, name, common_to="pixel")
        for k, pattern in enumerate(prediction.patterns, 1):
            yield self._share(PREDICTION, pattern / level, f"pattern {k}")
        yield self._share(PREDICTION, prediction.rest / level, all_bands=False)

    def _share(self, name: str, size: np.ndarray, owner: str = "", **more: Any) -> ErrorSource:
        sizes = dict(zip(self.labels, size.tolist(), strict=True))
        options = {"common_to": "region", "all_bands": True, **more}
        return ErrorSource(name, "sigma", sizes, owner=owner, **options)


def noise_of_residuals(
    slopes: np.ndarray, noise: np.ndarray | None, measured: np.ndarray | None
) -> np.ndarray:
    """Return the covariance, (bands, bands), of held-out errors by noise, standard deviations, of responses and measured spectra."""
    made = np.zeros((slopes.shape[1],) * 2)
    if noise is not None:
        carried = slopes * noise[:, None]
        made += np.einsum("nbc,ndc->bd", carried, carried) / len(noise)
    if measured is not None:
        made += np.diag(np.square(measured).mean(0))
    return made
