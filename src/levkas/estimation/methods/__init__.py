"""Methods of spectral estimation: one row each, and fitted models on the disk.

A method's `fit` takes `Training` and a random generator and returns a model; ``model(responses)`` returns
spectra (m, bands) and their sigma, or None.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from levkas.core.files import write_bytes
from levkas.core.problems import Problem, Refused
from levkas.estimation.methods.linear_model import LinearModel
from levkas.estimation.methods.pseudo_inverse import fit_pseudo_inverse
from levkas.estimation.methods.wiener import fit_wiener
from levkas.estimation.model import EstimationMethod, Model

__all__ = ["METHODS", "EstimationMethod", "Model", "find_method", "load_model", "save_model"]

VERSION = 1
"""Of stored models; another is refused."""

METHODS = {
    method.name: method
    for method in [
        EstimationMethod(
            "pseudo-inverse",
            "Pseudo-inverse",
            fit_pseudo_inverse,
            LinearModel,
            r"\hat y = x X^{+} Y",
            "heikkinen2008",
        ),
        EstimationMethod(
            "wiener",
            "Wiener (LMMSE)",
            fit_wiener,
            LinearModel,
            r"\hat y = \bar y + (x - \bar x)(C_{xx} + \tfrac{\lambda}{n} I)^{-1} C_{xy}",
            "murakami2008",
        ),
    ]
}


def find_method(name: str) -> EstimationMethod:
    """Return a method by its name.

    Raises
    ------
    Refused
        With code ``E_METHOD`` for a name that no method has.
    """
    if name not in METHODS:
        raise Refused(
            Problem(
                "E_METHOD",
                "there is no such method of estimation",
                found=name,
                expected=", ".join(METHODS),
            )
        )
    return METHODS[name]


def save_model(path: str | Path, method: str, model: Model) -> None:
    """Write a fitted model and the name of its method, as arrays in one .npz."""
    packed = io.BytesIO()
    np.savez_compressed(
        packed, allow_pickle=False, method=method, version=VERSION, **model.arrays()
    )
    write_bytes(path, packed.getvalue())


def load_model(path: str | Path) -> tuple[str, Model]:
    """Read a fitted model.

    Returns
    -------
    method : str
    model : Model

    Raises
    ------
    Refused
        With code ``E_MODEL`` where the file is not such a model, or one of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as packed:
            arrays = {name: packed[name] for name in packed.files}
        method, version = str(arrays.pop("method")), int(arrays.pop("version"))
        if version != VERSION:
            raise ValueError(f"version {version}, expected {VERSION}")
        return method, find_method(method).model.from_arrays(arrays)
    except (OSError, ValueError, TypeError, KeyError, zipfile.BadZipFile) as error:
        raise Refused(
            Problem(
                "E_MODEL",
                f"no fitted model of this version: {error}",
                file=str(path),
                fix="fit it anew with `levkas estimate`",
            )
        ) from None
