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
from levkas.estimation.methods.wiener import fit_wiener
from levkas.estimation.model import EstimationMethod, Model
from levkas.readers.arrays import DAMAGE, read_npz

__all__ = ["METHODS", "EstimationMethod", "Model", "find_method", "load_model", "save_model"]

VERSION = 3
"""Of stored models; another is refused."""
LARGEST = 64 << 20
"""Bytes of a stored model's arrays; a Gaussian process of 1,500 anchors has 18 MB."""

LINEAR, KERNELS = LinearModel.from_arrays, KernelModel.from_arrays
PROCESS = GaussianProcessModel.from_arrays
ROWS = [
    EstimationMethod("pseudo-inverse", "Pseudo-inverse", fit_pseudo_inverse, LINEAR),
    EstimationMethod("wiener", "Wiener (LMMSE)", fit_wiener, LINEAR),
    EstimationMethod("matern", "Kernel ridge, Matérn 3/2", fit_kernel_ridge, KERNELS),
    EstimationMethod("gaussian-process", "Gaussian process", fit_gaussian_process, PROCESS),
]
"""Equation and source of each are in its module."""

METHODS = {method.name: method for method in ROWS}


def find_method(name: str) -> EstimationMethod:
    """Return a method by its name."""
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
    """Read a fitted model."""
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
