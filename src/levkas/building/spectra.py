"""The channel that a camera's own frame means."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.cube import find_band
from levkas.core.problems import Problem, Refused
from levkas.core.text import TextRefused, read_text
from levkas.readers.spectra import are_spectra, parse_spectra

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.core.cube import Band


def reference_channel(
    campaign: Campaign, camera: str, bands: Sequence[Band], wavelength: float
) -> str:
    """Return the band meant by `CAMERA` without a band.

    The declared `reference_band`, else the band whose wavelength (or sensitivity's centroid) is
    nearest to the reference band's, else the middle one as declared.
    """
    keys = campaign.cameras[camera]
    labels = [band.label for band in bands]
    if keys.reference_band:
        return labels[find_band(labels, keys.reference_band, [b.wavelength for b in bands])]
    centres = [band.wavelength for band in bands]
    if any(isnan(c) for c in centres) and keys.sensitivity:
        wavelengths, table = read_sensitivity(campaign.root / keys.sensitivity, labels)
        centres = list(centroids(wavelengths, table))
    distances = np.abs(np.array(centres, float) - wavelength)
    distances[[band.bad for band in bands]] = np.nan
    if isnan(wavelength) or np.isnan(distances).all():
        return middle_band(bands)
    return labels[int(np.nanargmin(distances))]


def middle_band(bands: Sequence[Band]) -> str:
    """Return the label of the band in the middle, of those that are not bad."""
    good = [band.label for band in bands if not band.bad] or [band.label for band in bands]
    return good[len(good) // 2]


def broad_centroids(campaign: Campaign, camera: str, bands: Sequence[Band]) -> dict[str, float]:
    """Return the centroids of a camera's channels without a centre wavelength, nm, by label.

    Parameters
    ----------
    bands : sequence of Band
        All of the camera, of every sensor.

    Returns
    -------
    centroids : dict
        Empty where no sensitivities are declared; without a channel that nothing reaches.

    Raises
    ------
    Refused
        Where the declared table cannot be read.
    """
    declared = campaign.cameras[camera].sensitivity
    broad = [band.label for band in bands if isnan(band.wavelength)]
    if not declared or not broad:
        return {}
    labels = [band.label for band in bands]
    found = centroids(*read_sensitivity(campaign.root / declared, labels))
    known = dict(zip(labels, found.tolist(), strict=True))
    return {label: known[label] for label in broad if not isnan(known[label])}


def read_sensitivity(path: Path, labels: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Read a CSV of wavelength and a column a channel; columns by header where it names them all.

    Returns
    -------
    wavelengths : ndarray, (n,), nm
        Ascending, whatever the order of the rows.
    table : ndarray, (n, channels)

    Raises
    ------
    Refused
        Where it cannot be read, a wavelength occurs twice, or it has not as many columns as there
        are channels.
    """
    expected = "a CSV with wavelength in nm and one column per channel"
    try:
        table, head = parse_spectra(read_text(path, expected))
        if not are_spectra(table):
            raise ValueError(f"{len(table)} rows, or wavelengths that are missing or repeated")
        if table[0, 0] < LOWEST_NM:
            raise ValueError(f"wavelengths from {table[0, 0]:g} to {table[-1, 0]:g}")
    except ValueError as error:
        message = "the sensitivities cannot be read"
        raise Refused(
            Problem("E_UNREADABLE", message, str(path), found=str(error), expected=expected)
        ) from error
    columns = list(range(1, table.shape[1]))
    if len(head) == table.shape[1] and all(label in head for label in labels):
        columns = [head.index(label) for label in labels]
    if len(columns) != len(labels):
        raise Refused(
            Problem(
                "E_BAND_COUNT",
                "the sensitivities do not match the channels",
                str(path),
                found=f"{len(columns)} columns",
                expected=f"{len(labels)}: {', '.join(labels)}",
            )
        )
    return table[:, 0], np.nan_to_num(table[:, columns])


def centroids(wavelengths: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the centroid of each sensitivity, nm.

    >>> centroids(np.array([500.0, 600.0]), np.array([[1.0], [3.0]])).tolist()
    [575.0]
    """
    weights = np.maximum(table, 0)
    total = weights.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((wavelengths[:, None] * weights).sum(0) / total)


VISIBLE = (400.0, 700.0)
LOWEST_NM = 100.0


class SpectrumRefused(Refused):
    """A spectrum that cannot be read or does not cover the bands."""


def white_reflectance(campaign: Campaign, bands: Sequence[Band]) -> float | np.ndarray:
    """Reflectance of the white target: one number, or one a band.

    A channel without a wavelength takes the mean over 400–700 nm.

    Raises SpectrumRefused where the CSV cannot be used.
    """
    white = campaign.targets.white
    declared = white.reflectance if white else None
    if declared is None:
        return 1.0
    if not isinstance(declared, str):
        return float(declared)
    wavelengths, values = read_spectrum(campaign.root / declared)
    centres = np.array([band.wavelength for band in bands], float)
    known = centres[np.isfinite(centres)]
    if known.size and (known.min() < wavelengths[0] - 1 or known.max() > wavelengths[-1] + 1):
        raise SpectrumRefused(
            Problem(
                "E_VALUE",
                "the white's spectrum does not cover the bands",
                file=str(campaign.root / declared),
                field="wavelength",
                found=f"{wavelengths[0]:g} to {wavelengths[-1]:g} nm",
                expected=f"{known.min():g} to {known.max():g} nm",
                fix="Give a spectrum that covers every band.",
            )
        )
    visible = (wavelengths >= VISIBLE[0]) & (wavelengths <= VISIBLE[1])
    broad = float(values[visible].mean()) if visible.any() else float(values.mean())
    return np.where(
        np.isfinite(centres), np.interp(np.nan_to_num(centres), wavelengths, values), broad
    )


def read_spectrum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a two-column CSV: wavelength in nm, and a share or per cent; a header is allowed.

    Raises SpectrumRefused where it is not that.
    """
    table = read_table(path)
    values = table[:, 1] / 100 if table[:, 1].max() > 2 else table[:, 1]
    return table[:, 0], values


def read_table(path: Path) -> np.ndarray:
    """Read the numbers of a two-column CSV, (n, 2): wavelengths in nm, rising, and values as they are.

    Raises SpectrumRefused where it is not that.
    """
    expected = "a CSV of wavelength in nm and value"
    try:
        table, _ = parse_spectra(read_text(path, expected), columns=2)
    except TextRefused as refused:
        raise SpectrumRefused(*refused.problems) from None
    except ValueError as error:
        raise SpectrumRefused(
            Problem(
                "E_UNREADABLE",
                "the spectrum cannot be read",
                str(path),
                found=str(error),
                expected=expected,
                fix="Name the correct file, or save the table again as CSV.",
            )
        ) from error
    if not are_spectra(table) or not np.isfinite(table).all() or table[0, 0] < LOWEST_NM:
        raise SpectrumRefused(
            Problem(
                "E_VALUE",
                "this is not a spectrum",
                str(path),
                found=f"{len(table)} rows, or repeated wavelengths",
                expected="at least two rows of wavelength in nm and value",
                fix="Name the correct file, or correct its rows.",
            )
        )
    return table
