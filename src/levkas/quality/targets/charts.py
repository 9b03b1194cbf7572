"""Colour charts: how their patches lie, what these reflect, and where they are in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.campaign.chart_names import NEAR_NM, kind_of_chart
from levkas.core.problems import Problem, Refused, closest_match
from levkas.geometry.transforms import Homography
from levkas.readers.spectra import are_spectra, parse_spectra

if TYPE_CHECKING:
    from collections.abc import Sequence

HERE = Path(__file__)
"""Beside it stand tables of colour-science 0.4: BabelColor's average of 30 charts, and luminances of charts
made after November 2014."""
SAMPLED = 0.5
"""Side of the sampled area over the pitch of the patches."""
LEAST_SIDE = 6.0
"""Of a sampled area, px: fewer pixels do not show the noise."""


class ChartRefused(Refused):
    """A chart that cannot be measured: not there, cut off, too small, or another one."""


@dataclass(frozen=True)
class Chart:
    """The layout of a chart.

    Parameters
    ----------
    greys : tuple of int
        Indices of the grey scale, brightest first.
    """

    name: str
    columns: int
    rows: int
    greys: tuple[int, ...]

    @property
    def patches(self) -> tuple[str, ...]:
        """Names, row by row from the top left: letter of the column, number of the row."""
        return tuple(f"{chr(65 + c)}{r + 1}" for r in range(self.rows) for c in range(self.columns))

    @property
    def centres(self) -> np.ndarray:
        """(n, 2) places in units of the pitch; the first patch is (0, 0)."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.stack([x.ravel(), y.ravel()], -1).astype(float)

    @property
    def corners(self) -> np.ndarray:
        """(4, 2) places of the corner patches, clockwise from the first."""
        right, bottom = self.columns - 1.0, self.rows - 1.0
        return np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]])

    @cached_property
    def luminances(self) -> np.ndarray:
        """(n,) relative luminances as published, for recognising the chart and its orientation."""
        sg, classic = "luminances_sg.csv", "luminances_classic.csv"
        table = HERE.with_name(sg if self.rows == 10 else classic)
        return np.loadtxt(table, delimiter=",", skiprows=1, usecols=1)


CHARTS = {
    "ColorChecker24": Chart("ColorChecker24", 6, 4, (18, 19, 20, 21, 22, 23)),
    # E5 to J5 and E6 to J6 by brightness: E5 is the white, E6 the black.
    "ColorCheckerSG": Chart("ColorCheckerSG", 14, 10, (60, 79, 61, 78, 62, 77, 63, 76, 64, 75, 65, 74)),
}  # fmt: skip


def chart_of(name: str) -> Chart:
    """Return a chart by its name, or a word of `levkas look`; spaces, hyphens and case do not matter.

    Examples
    --------
    >>> chart_of("ColorChecker Classic").patches[:2], chart_of("colour-checker SG").rows, chart_of("Farbkarte").rows
    (('A1', 'B1'), 10, 4)
    """
    if kind := kind_of_chart(name):
        return CHARTS[kind]
    raise ChartRefused(
        Problem(
            "E_CHART_KIND",
            "there is no such chart",
            field="targets.charts",
            found=name,
            expected=", ".join((*CHARTS, EDGES, TRAP)),
            fix=closest_match(name, (*CHARTS, EDGES, TRAP))
            or "Name one of these; others may be measured by hand as objects.",
        )
    )


EDGES, TRAP = "edges", "trap"
"""Kinds of a target without a colour chart: of slanted edges, and of a light trap."""


def kind_of(name: str) -> Chart | None:
    """Return a chart by its name, None for a target of slanted edges or traps alone; raises as `chart_of`."""
    return None if name.strip().lower() in (EDGES, TRAP) else chart_of(name)


class ChartReference(NamedTuple):
    """Reflectances of a chart's patches.

    `wavelengths` (m,) nm, `spectra` (n, m), `source` for captions.
    """

    wavelengths: np.ndarray
    spectra: np.ndarray
    source: str

    def at(self, wavelengths: np.ndarray) -> np.ndarray:
        """Return reflectances at some wavelengths, (n, k); NaN beyond what was measured."""
        rows = [np.interp(wavelengths, self.wavelengths, s) for s in self.spectra]
        return np.where(self.covers(wavelengths), np.array(rows), np.nan)

    def covers(self, wavelengths: np.ndarray) -> np.ndarray:
        """Return where the spectra are known: where they were measured, and 5 nm beyond; not at NaN."""
        low, high = self.wavelengths[0] - NEAR_NM, self.wavelengths[-1] + NEAR_NM
        return np.asarray((wavelengths >= low) & (wavelengths <= high))


def reference_of(chart: Chart) -> ChartReference | None:
    """Return the published spectra of a chart: BabelColor's average of 30; of the SG there are none."""
    if chart.rows != 4:
        return None
    table = np.loadtxt(HERE.with_name("babelcolor_average.csv"), delimiter=",", skiprows=1)
    return ChartReference(table[:, 0], np.ascontiguousarray(table[:, 1:].T), "BabelColor average")


def parse_reference(text: str, chart: Chart, *, file: str = "") -> ChartReference:
    """Read a chart's spectra from CSV: wavelength in nm, then a column a patch.

    Parameters
    ----------
    text : str
        The header names patches by column and row: ``A:1`` or ``A1``. Per cent are recognised by their size.
    file : str
        For messages.
    """
    try:
        table, head = parse_spectra(text)
    except ValueError as error:
        raise _bad_reference(file, str(error), "numbers") from None
    if not head or len(table) < 2:
        rows = len(table) + bool(head)
        raise _bad_reference(file, f"{rows} rows", "a header and two wavelengths or more")
    names = ["".join(c for c in cell if c.isalnum()).upper() for cell in head[1:]]
    missing = [patch for patch in chart.patches if patch not in names]
    if missing:
        expected = f"a column for each of {len(chart.patches)} patches"
        raise _bad_reference(file, f"no {', '.join(missing[:5])}", expected)
    if table.shape[1] != len(names) + 1 or not np.isfinite(table).all():
        raise _bad_reference(file, "rows of several lengths, or NaN", "a number a patch")
    if not are_spectra(table):
        raise _bad_reference(file, "wavelengths that are none or not distinct", "each once, in nm")
    spectra = table[:, 1:].T[[names.index(patch) for patch in chart.patches]]
    spectra = spectra / 100 if spectra.max() > 2 else spectra
    return ChartReference(table[:, 0], spectra, file.rsplit("/", 1)[-1] or "CSV")


def _bad_reference(file: str, found: str, expected: str) -> ChartRefused:
    return ChartRefused(
        Problem(
            "E_CHART_REFERENCE",
            "the chart's reference spectra cannot be used",
            file=file or None,
            found=found,
            expected=expected,
            fix="Write wavelength,A:1,A:2,… in the header, and a row a wavelength.",
        )
    )


# --- places in a picture ------------------------------------------------------------------------


def place_patches(
    corners: np.ndarray, chart: Chart, size: tuple[int, int], *, sampled: float = SAMPLED
) -> np.ndarray:
    """Return the sampled area of every patch.

    Parameters
    ----------
    corners : (4, 2), px
        Centres of the four corner patches, clockwise from the first: dark skin, bluish green,
        black and white of the Classic.
    size : (width, height) of the picture
    sampled : float
        Side of an area over the pitch.

    Raises
    ------
    ChartRefused
        ``E_VALUE`` where the corners make no convex figure, ``E_CHART_FRAME`` where a patch lies
        beyond the frame, ``E_CHART_SIZE`` where the areas are too small.

    Examples
    --------
    >>> areas = place_patches([[50, 50], [550, 50], [550, 350], [50, 350]], CHARTS["ColorChecker24"], (600, 400))
    >>> areas.shape, areas[0].round(9).tolist()
    ((24, 4, 2), [[25.0, 25.0], [75.0, 25.0], [75.0, 75.0], [25.0, 75.0]])
    """
    corners = np.asarray(corners, float).reshape(4, 2)
    _check_convex(corners)
    plane = Homography.fit(chart.corners, corners)
    half = sampled / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    areas = plane((chart.centres[:, None] + half).reshape(-1, 2)).reshape(-1, 4, 2)
    beyond = np.any((areas < 0) | (areas > np.array(size) - 1.0), axis=(1, 2))
    if beyond.any():
        names = [chart.patches[i] for i in np.flatnonzero(beyond)]
        raise ChartRefused(
            Problem(
                "E_CHART_FRAME",
                "the chart is partly out of the frame",
                found=f"{len(names)} patches beyond it: {', '.join(names[:6])}",
                expected=f"all {len(chart.patches)} patches inside",
                fix="Capture the whole chart, with a hand's breadth around it.",
            )
        )
    side = float(np.linalg.norm(areas - np.roll(areas, 1, axis=1), axis=2).min())
    if side < LEAST_SIDE:
        raise ChartRefused(
            Problem(
                "E_CHART_SIZE",
                "the chart is too small in the picture",
                found=f"{side:.1f} px a sampled area",
                expected=f"{LEAST_SIDE:g} px or more",
                fix="Capture the chart from nearer, or by a camera that resolves it.",
            )
        )
    return areas


def parse_corners(text: str) -> np.ndarray:
    """Return four corners from ``x,y,x,y,x,y,x,y``, (4, 2).

    Examples
    --------
    >>> parse_corners("0,0,10,0,10,8,0,8").tolist()[2]
    [10.0, 8.0]
    """
    try:
        corners = np.array([float(part) for part in text.replace(";", ",").split(",")])
        return corners.reshape(4, 2)
    except ValueError:
        raise ChartRefused(
            Problem(
                "E_VALUE",
                "the corners cannot be read",
                field="--corners",
                found=text,
                expected="eight numbers: x,y,x,y,x,y,x,y",
                fix="Centres of the corner patches, clockwise from the first: dark skin, bluish "
                "green, black, white of the Classic.",
            )
        ) from None


def _check_convex(corners: np.ndarray) -> None:
    edges = np.roll(corners, -1, 0) - corners
    turns = edges[:, 0] * np.roll(edges, -1, 0)[:, 1] - edges[:, 1] * np.roll(edges, -1, 0)[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)) or not np.isfinite(corners).all():
        raise ChartRefused(
            Problem(
                "E_VALUE",
                "the four corners make no chart",
                field="--corners",
                found="; ".join(f"{x:g},{y:g}" for x, y in corners),
                expected="centres of the corner patches, clockwise from the first (dark skin)",
            )
        )


def pixels_of(area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (rows, columns) of the pixels whose centres lie in a convex area, (4, 2) px.

    >>> rows, columns = pixels_of(np.array([[0, 0], [2, 0], [2, 1], [0, 1.0]]))
    >>> len(rows), int(columns.max())
    (6, 2)
    """
    low, high = np.ceil(area.min(0)).astype(int), np.floor(area.max(0)).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    edges = np.roll(area, -1, 0) - area
    sides = [ex * (y - ay) - ey * (x - ax) for (ax, ay), (ex, ey) in zip(area, edges, strict=True)]
    inside = np.all([s >= -1e-9 for s in sides], 0) | np.all([s <= 1e-9 for s in sides], 0)
    return y[inside], x[inside]


def turned_corners(corners: np.ndarray) -> Sequence[np.ndarray]:
    """Return the eight ways to name four corners of a rectangle: turned, and mirrored."""
    forward = [np.roll(corners, -k, axis=0) for k in range(4)]
    return [*forward, *(c[[1, 0, 3, 2]] for c in forward)]
