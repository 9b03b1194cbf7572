"""Drawings of a plan as SVG text: axes, curves, contours. Colours are the page's own variables."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

PALETTE = ("--c1", "--c2", "--c3", "--c4", "--c5", "--c6")


@dataclass(frozen=True)
class Frame:
    """A plot's place on the page and the values at its edges."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Bring values on to the page."""
        across = self.left + self.width * (np.asarray(x) - self.x[0]) / (self.x[1] - self.x[0])
        down = self.top + self.height * (self.y[1] - np.asarray(y)) / (self.y[1] - self.y[0])
        return across, down


def svg(width: float, height: float, parts: Sequence[str], label: str) -> str:
    """Return a drawing; `label` is what a screen reader says."""
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def escape(text: str) -> str:
    """Return text that is safe between tags and in attributes.

    >>> escape('<"&')
    '&lt;&quot;&amp;'
    """
    from xml.sax.saxutils import escape as escaped

    return escaped(text, {'"': "&quot;"})


def text(
    x: float, y: float, words: str, *, anchor: str = "start", css: str = "", fill: str = ""
) -> str:
    """Return words at a place."""
    style = f' style="fill:var({fill})"' if fill else ""
    named = f' class="{css}"' if css else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{named}{style}>{escape(words)}</text>'
    )


def line(x: np.ndarray, y: np.ndarray, colour: str, *, width: float = 1.8, dash: str = "") -> str:
    """Return a curve through points of the page."""
    pairs = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(np.ravel(x), np.ravel(y), strict=True))
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polyline points="{pairs}" fill="none" stroke="var({colour})" stroke-width="{width}"'
        f' stroke-linejoin="round"{dashes}/>'
    )


def polygon(points: np.ndarray, fill: str, *, opacity: float = 1.0, stroke: str = "") -> str:
    """Return a filled outline; `points` (n, 2) of the page."""
    pairs = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
    edge = f' stroke="var({stroke})"' if stroke else ""
    return f'<polygon points="{pairs}" fill="var({fill})" fill-opacity="{opacity}"{edge}/>'


def nice_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return round values between two.

    >>> nice_ticks(0.0, 1.0)
    [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    raw = (high - low) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(power * next(m for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999))
    first = int(np.ceil(low / step - 1e-9))
    return [round(i * step, 10) for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def axes(frame: Frame, x_label: str, y_label: str, *, about: tuple[int, int] = (6, 5)) -> list[str]:
    """Return grid, numbers and labels of a plot."""
    bottom, right = frame.top + frame.height, frame.left + frame.width
    parts = []
    for value in nice_ticks(*frame.y, about[1]):
        y = float(frame.at(0, value)[1])
        parts.append(f'<path d="M{frame.left} {y:.1f}H{right}" stroke="var(--line)"/>')
        parts.append(text(frame.left - 7, y + 4, f"{value:g}", anchor="end"))
    for value in nice_ticks(*frame.x, about[0]):
        x = float(frame.at(value, 0)[0])
        parts.append(f'<path d="M{x:.1f} {bottom}v5" stroke="var(--soft)"/>')
        parts.append(text(x, bottom + 18, f"{value:g}", anchor="middle"))
    parts.append(f'<path d="M{frame.left} {bottom}H{right}" stroke="var(--soft)"/>')
    parts.append(text((frame.left + right) / 2, bottom + 36, x_label, anchor="middle"))
    parts.append(text(frame.left - 40, frame.top - 10, y_label))
    return parts


def contours(
    x: np.ndarray, y: np.ndarray, values: np.ndarray, level: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the pieces of a level line: marching squares.

    Parameters
    ----------
    x, y : ndarray, (columns,), (rows,)
    values : ndarray, (rows, columns)
    level : float

    Returns
    -------
    pieces : list of (start, end)
        Each (2,) in the units of x and y; a saddle is joined by its mean.

    Examples
    --------
    >>> x = y = np.array([0.0, 1.0])
    >>> [[p.tolist() for p in piece] for piece in contours(x, y, np.array([[0, 1], [0, 1.0]]), 0.25)]
    [[[0.25, 0.0], [0.25, 1.0]]]
    """
    pieces = []
    above = values > level
    mixed = above[:-1, :-1].astype(int) + above[:-1, 1:] + above[1:, :-1] + above[1:, 1:]
    for i, j in np.argwhere((mixed > 0) & (mixed < 4)):
        corners = [(j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)]
        crossed = []
        for (a, b), (c, d) in zip(corners, corners[1:] + corners[:1], strict=True):
            one, other = values[b, a], values[d, c]
            if (one > level) != (other > level):
                t = (level - one) / (other - one)
                crossed.append(
                    np.array([x[a] + t * (x[c] - x[a]), y[b] + t * (y[d] - y[b])], float)
                )
        if len(crossed) == 4 and (values[i : i + 2, j : j + 2].mean() > level) == above[i, j]:
            crossed = crossed[1:] + crossed[:1]
        pieces += list(zip(crossed[::2], crossed[1::2], strict=True))
    return pieces


def picture(values: np.ndarray, low: float, high: float, stops: Sequence[str]) -> str:
    """Return a map as a PNG data address: values from `low` to `high` over colours ``#rrggbb``."""
    from PIL import Image

    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    table = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in stops], float)
    at = np.linspace(0, 1, len(table))
    rgb = np.stack([np.interp(share, at, table[:, k]) for k in range(3)], -1)
    stream = io.BytesIO()
    Image.fromarray(np.round(rgb).astype(np.uint8)).save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
