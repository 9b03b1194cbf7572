"""The reflectance of the white board in every band."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.readers.text import TextRefused, read_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.core.cube import Band

VISIBLE = (400.0, 700.0)


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
    rows, headed = [], False
    try:
        lines = io.StringIO(read_text(path, "a CSV of wavelength in nm and value"), newline="")
        for row in csv.reader(lines):
            if not row or row[0].lstrip().startswith("#"):
                continue
            try:
                rows.append((float(row[0]), float(row[1])))
            except (ValueError, IndexError):
                if rows or headed:
                    raise
                headed = True
    except TextRefused as refused:
        raise SpectrumRefused(*refused.problems) from None
    except (ValueError, IndexError, csv.Error) as error:
        raise SpectrumRefused(
            Problem(
                "E_UNREADABLE",
                "the spectrum cannot be read",
                str(path),
                found=str(error),
                expected="a CSV of wavelength in nm and value",
                fix="Name the right file, or save the table again as CSV.",
            )
        ) from error
    table = np.array(sorted(rows), float).reshape(-1, 2)
    twice = len(table) > 1 and not (np.diff(table[:, 0]) > 0).all()
    if len(table) < 2 or twice or not np.isfinite(table).all() or table[0, 0] < 100:
        raise SpectrumRefused(
            Problem(
                "E_VALUE",
                "this is no spectrum",
                str(path),
                found="a wavelength that stands twice" if twice else f"{len(table)} rows",
                expected="two rows or more of wavelength in nm and value",
                fix="Name the right file, or mend its rows.",
            )
        )
    return table
