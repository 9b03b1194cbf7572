"""A fitted model on the disk with what it was fitted on, as ``levkas estimate -o`` writes it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Band
from levkas.core.files import make_folder, write_json
from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem
from levkas.core.text import read_json
from levkas.estimation.methods import Model, load_model, save_model
from levkas.estimation.samples import EstimationRefused
from levkas.estimation.uncertainty import ModelErrors

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class StoredModel:
    """A model and what it may be applied to.

    Parameters
    ----------
    sources : tuple of str
        Layers whose channels are its responses, in order.
    target : str
        Layer whose spectra it was fitted to.
    bands : tuple of Band
        Of the spectra.
    training : tuple of str
        Paintings that it was fitted on.
    sigma : tuple of float
        RMSE of each band on held-out paintings.
    errors : ModelErrors
        What all its estimates have in common.
    """

    method: str
    model: Model
    sources: tuple[str, ...]
    target: str
    bands: tuple[Band, ...]
    training: tuple[str, ...]
    sigma: tuple[float, ...]
    errors: ModelErrors

    def facts(self) -> dict[str, Any]:
        """Return all but the model itself."""
        record = {name: value for name, value in vars(self).items() if name != "model"}
        bands = [asdict(band) for band in self.bands]
        return {**record, "bands": bands, "errors": self.errors.to_dict()}

    def predict(self, cube: xarray.DataArray | np.ndarray) -> xarray.DataArray:
        """Estimate the spectra of pixels.

        Parameters
        ----------
        cube : array, (…, channels)
            The channels that the model was fitted with, in order: of one layer, or of several side by side
            (``xarray.concat`` along the bands). Of a labelled array ``band`` may stand anywhere.

        Returns
        -------
        spectra : xarray.DataArray, (…, band), float64
            With ``wavelength``, and ``sigma``: the error of each band on held-out paintings. NaN where a channel has no value.
            Estimated, not measured: the attribute `kind` says so.

        Raises
        ------
        Refused
            ``E_CHANNELS`` where the cube has other channels.
        """
        import xarray

        moved = (
            cube.transpose(..., "band")
            if isinstance(cube, xarray.DataArray)
            else xarray.DataArray(cube)
        )
        values = np.asarray(moved.values, float)
        flat = values.reshape(-1, values.shape[-1])
        known = np.isfinite(flat).all(1)
        spectra = np.full((len(flat), len(self.bands)), np.nan)
        with steady_libraries():
            spectra[known] = self.model(flat[known])[0]
        kept = {n: c for n, c in moved.coords.items() if set(c.dims) <= set(moved.dims[:-1])}
        about = {
            "band": [band.label for band in self.bands],
            "wavelength": ("band", [band.wavelength for band in self.bands], {"units": "nm"}),
            "sigma": ("band", list(self.sigma)),
        }
        facts = {
            "quantity": "reflectance",
            "kind": "estimated",
            "method": self.method,
            "units": "1",
        }
        shape = (*values.shape[:-1], len(self.bands))
        return xarray.DataArray(
            spectra.reshape(shape),
            {**kept, **about},
            (*moved.dims[:-1], "band"),
            "estimated",
            facts,
        )

    def save(self, path: Path) -> list[Path]:
        """Write ``NAME.npz`` and ``NAME.json``; return both."""
        make_folder(path.parent)
        save_model(path, self.method, self.model)
        write_json(path.with_suffix(".json"), self.facts())
        return [path, path.with_suffix(".json")]

    def require_channels(self, channels: int, path: Path) -> None:
        """Refuse a model whose arrays do not lead from so many channels to its bands."""
        responses = np.full((2, channels), 0.5)
        try:
            with np.errstate(all="ignore"):
                parts = [part for part in self.model(responses) if part is not None]
            wrong: list[object] = [
                part.shape for part in parts if part.shape != (2, len(self.bands))
            ]
            wrong += [part.dtype for part in parts if part.dtype.kind != "f"]
            wrong += ["no numbers" for part in parts if not wrong and not np.isfinite(part).all()]
            why = f"it gives {wrong[0]} for 2 pixels" if wrong else ""
        except (ArithmeticError, LookupError, MemoryError, TypeError, ValueError) as error:
            why = " ".join(str(error).split())[:200] or type(error).__name__
        if why:
            raise EstimationRefused(
                Problem(
                    "E_MODEL",
                    f"the arrays of the model do not fit together: {why}",
                    str(path),
                    expected=f"{channels} channels to {len(self.bands)} bands",
                    fix="Fit it again with `levkas estimate -o`.",
                )
            )


def read_model(path: Path) -> StoredModel:
    """Read a model and its facts."""
    method, model = load_model(path)
    record = read_json(path.with_suffix(".json"))
    try:
        bands = tuple(
            Band(str(b["label"]), _number(b["wavelength"]), _number(b["fwhm"]))
            for b in record["bands"]
        )
        names = {k: tuple(map(str, record[k])) for k in ("sources", "training")}
        sigma = tuple(float(value) for value in record["sigma"])
        if str(record["method"]) != method or len(sigma) != len(bands):
            raise ValueError(f"the facts of a model by {record['method']}, of {len(sigma)} bands")
        errors = ModelErrors.from_dict(record["errors"], len(bands))
        target = str(record["target"])
        return StoredModel(
            *(method, model, names["sources"], target, bands, names["training"], sigma, errors)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise EstimationRefused(
            Problem(
                "E_MODEL",
                f"the facts beside the model do not belong to it: {error}",
                str(path.with_suffix(".json")),
                fix="Fit it again with `levkas estimate -o`.",
            )
        ) from None


def bands_of(layer: xarray.DataArray) -> tuple[Band, ...]:
    """Return the bands of an opened layer."""
    columns = (layer.band.values, layer.wavelength.values, layer.fwhm.values)
    return tuple(Band(str(b), float(w), float(f)) for b, w, f in zip(*columns, strict=True))


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
