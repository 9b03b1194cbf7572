"""Methods of spectral estimation: one row each, and fitted models on the disk.

A method's `fit` takes `Training` and a random generator and returns a model; ``model(responses)`` returns
spectra (m, bands) and their sigma, or None.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from levkas.core.files import write_bytes
from levkas.core.problems import Problem, Refused, closest_match
from levkas.estimation.methods.gaussian_process import GaussianProcessModel, fit_gaussian_process
from levkas.estimation.methods.kernel_ridge import KernelModel, fit_kernel_ridge
from levkas.estimation.methods.linear_model import LinearModel
from levkas.estimation.methods.pseudo_inverse import fit_pseudo_inverse
from levkas.estimation.methods.root_polynomial import fit_root_polynomial
from levkas.estimation.methods.wiener import fit_wiener
from levkas.estimation.model import EstimationMethod, Model
from levkas.readers.arrays import DAMAGE, read_npz

__all__ = [
    "METHODS",
    "EstimationMethod",
    "Model",
    "find_method",
    "load_model",
    "save_model",
]

VERSION = 2
"""Of stored models; another is refused."""
LARGEST = 64 << 20
"""Bytes of a stored model's arrays; a Gaussian process of 1,500 anchors has 18 MB."""

LINEAR = LinearModel.from_arrays
ROWS = [
    EstimationMethod(
        "pseudo-inverse", "Pseudo-inverse", fit_pseudo_inverse, LINEAR,
        r"\hat y = x X^{+} Y", "heikkinen2008",
    ),
    EstimationMethod(
        "wiener", "Wiener (LMMSE)", fit_wiener, LINEAR,
        r"\hat y = \bar y + (x - \bar x)(C_{xx} + \tfrac{\lambda}{n} I)^{-1} C_{xy}", "murakami2008",
    ),
    EstimationMethod(
        "root-polynomial", "Root-polynomial", fit_root_polynomial, LINEAR,
        r"\hat y = \sum_t B_t \Bigl(\prod_{c \in t} x_c\Bigr)^{1/|t|}", "finlayson2015",
    ),
    EstimationMethod(
        "matern", "Kernel ridge, Matérn 3/2", fit_kernel_ridge, KernelModel.from_arrays,
        r"\hat y = \bar y + k^\top (K + \lambda I)^{-1} Y_c,\; k = (1 + \sqrt3 r) e^{-\sqrt3 r}",
        "heikkinen2013",
    ),
    EstimationMethod(
        "gaussian-process", "Gaussian process", fit_gaussian_process, GaussianProcessModel.from_arrays,
        r"\sigma^2 = s^2 c^2 (1 + \lambda - k^\top (K + \lambda I)^{-1} k)", "rasmussen2006",
    ),
]  # fmt: skip

METHODS = {method.name: method for method in ROWS}


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
                "unknown method of estimation",
                found=name,
                expected=", ".join(METHODS),
                fix=closest_match(name, METHODS),
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
        arrays = read_npz(Path(path), most=LARGEST)
        method, version = str(arrays["method"]), int(arrays["version"])
        if version != VERSION:
            raise ValueError(f"version {version}, expected {VERSION}")
        return method, find_method(method).read(arrays)
    except (Refused, *DAMAGE) as error:
        reason = error.problems[0].message if isinstance(error, Refused) else str(error)
        raise Refused(
            Problem(
                "E_MODEL",
                f"no fitted model of this version: {reason}",
                file=str(path),
                fix="Fit it again with `levkas estimate -o`.",
            )
        ) from None
