"""Tables over wavelength as CSV: reflectances, sensitivities, light, charts."""

from __future__ import annotations

import csv
import io
from math import nan

import numpy as np


def parse_spectra(text: str, columns: int | None = None) -> tuple[np.ndarray, list[str]]:
    """Parse a CSV of wavelength in nm and columns of values, of which the first `columns` are read, wavelengths included.

    Lines that begin with # are left out; a header may come first. Rows come by ascending wavelength, NaN where a cell is
    empty, with the header's cells. Raises ValueError for text that is no number behind it, and rows of several lengths.

    >>> table, head = parse_spectra("nm,white\\n500,0.9\\n400,\\n")
    >>> table.tolist(), head
    ([[400.0, nan], [500.0, 0.9]], ['nm', 'white'])
    """
    rows: list[list[float]] = []
    head: list[str] = []
    try:
        for row in csv.reader(io.StringIO(text, newline="")):
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            try:
                rows.append([float(cell) if cell else nan for cell in cells[:columns]])
            except ValueError:
                if rows or head:
                    raise
                head = cells
    except csv.Error as error:
        raise ValueError(str(error)) from None
    table = np.array(rows, float) if rows else np.empty((0, 0))
    return table[np.argsort(table[:, 0])] if table.size else table, head


def are_spectra(table: np.ndarray) -> bool:
    """Whether a table has two rows and columns or more, distinct wavelengths above 0, no infinity."""
    return (
        min(table.shape) >= 2
        and not np.isinf(table).any()
        and bool(table[0, 0] > 0)
        and bool((np.diff(table[:, 0]) > 0).all())
    )
