"""What makes a value uncertain, how large it is, and what it is common to: rows of an uncertainty budget.

A value is its true one and a sum of errors of first order, q = q₀ + Σₖ cₖ ξₖ, with independent ξₖ of mean 0 and variance 1
([jcgm2008]_, 5.1, doi:10.59161/JCGM100-2008E; [mittaz2019]_ for images). The coefficients cₖ of all numbers that one error touches
belong together: so the mean of many pixels is no better known than what they share, and what two numbers share leaves their ratio.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np

Extent = Literal["pixel", "line", "region", "frame", "camera", "campaign"]
"""What one draw of an error is common to: the pixels of a line, of a region of one paint, of a capture, all captures of a camera,
or all cameras."""
Unit = Literal["relative", "reflectance", "counts", "nm", "px", "sigma"]
"""Of a size: of the value, absolute (of layers without a white in counts), of the wavelength (times the slope of the spectrum), of the
place (times that of the picture), of the published sigma of the pixels."""
Basis = Literal["measured", "declared", "unknown"]

COVERAGE = 2.0
"""Factor of an expanded uncertainty: about 95 % of normal errors."""


@dataclass(frozen=True)
class ErrorSource:
    """One row of a budget.

    Parameters
    ----------
    name : str
        What errs.
    size : mapping of str to float
        Standard uncertainty of each band, by label; bands without one are not known. Bands of one draw that it moves in opposite
        directions have opposite signs.
    common_to : Extent
        Within what one draw of the error holds.
    all_bands : bool
        Whether one draw holds for all bands, or each band has its own.
    advice : str
        Of an unknown one: what to capture or to declare, to know it.
    owner : str
        Which camera or campaign has the error in common where that is not where it stands: the file of a white's certificate.
    zero_at : mapping of str to float
        Value of each band at which the error is nil, the other side of which it has the other sign: a bent curve leaves
        what is as bright as the white, stray light what is as bright as the mean of the view. Empty: at no value.
    """

    name: str
    unit: Unit
    size: Mapping[str, float]
    common_to: Extent
    all_bands: bool
    basis: Basis = "measured"
    advice: str = ""
    owner: str = ""
    zero_at: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the row, JSON-ready, sizes with four digits; without what is empty."""
        row = {"source": self.name, **asdict(self)}
        for key in ("size", "zero_at"):
            row[key] = {band: float(f"{number:.4g}") for band, number in row[key].items()}
        del row["name"]
        return {key: value for key, value in row.items() if value not in ("", {})}

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> ErrorSource:
        """Read what `to_dict` gave; raises KeyError, TypeError or ValueError where it is none."""
        own = {"name": row["source"], **row}
        del own["source"]
        for key in ("size", "zero_at"):
            own[key] = {str(band): float(number) for band, number in dict(row.get(key, {})).items()}
        made = cls(**own)
        if made.unit not in get_args(Unit) or made.common_to not in get_args(Extent):
            raise ValueError(f"{made.name}: {made.unit}, common to {made.common_to}")
        return made


Part = tuple[str, str, Hashable]
"""Name of a source, whose error it is, and which of its draws."""


@dataclass(frozen=True, eq=False)
class Uncertain:
    """Numbers (n,), and how each error moves them: coefficients cₖ (n,) in the unit of the values.

    Examples
    --------
    Two bands that share 1 % of a white, each with noise of 0.003: their ratio does not know the white.

    >>> both = Uncertain(np.array([0.5, 0.25]), {
    ...     ("white", "", 0): np.array([0.005, 0.0025]),
    ...     ("noise", "", "R"): np.array([0.003, 0.0]), ("noise", "", "G"): np.array([0.0, 0.003])})
    >>> both.sigma.round(4).tolist(), both.through(lambda v: v[:1] / v[1:]).sigma.round(4).tolist()
    ([0.0058, 0.0039], [0.0268])
    """

    values: np.ndarray
    parts: dict[Part, np.ndarray] = field(default_factory=dict)

    @property
    def sigma(self) -> np.ndarray:
        """Standard uncertainty of each value, (n,)."""
        total: Any = sum((row**2 for row in self.parts.values()), np.zeros(len(self.values)))
        return np.asarray(np.sqrt(total))

    def pick(self, places: Sequence[int]) -> Uncertain:
        """Return some of the numbers, (m,)."""
        some = [*places]
        return Uncertain(self.values[some], {part: row[some] for part, row in self.parts.items()})

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the standard uncertainty of each value by each source, (n,), the largest first."""
        squares: dict[str, np.ndarray] = {}
        for (name, _, _), row in self.parts.items():
            squares[name] = squares.get(name, 0.0) + np.square(row)
        order = sorted(squares, key=lambda name: -float(squares[name].sum()))
        return {name: np.sqrt(squares[name]) for name in order}

    def through(
        self, function: Callable[[np.ndarray], np.ndarray], *, step: float = 1e-4
    ) -> Uncertain:
        """Return a function of the values, (n,) to (m,), with each error carried on by its slope, ([jcgm2008]_, Eq. 13).

        The function is smooth over the errors; `step` is half of what each value is changed by to find the slope.
        """
        at = np.asarray(self.values, float)
        slopes = np.array(
            [
                (np.ravel(function(at + d)) - np.ravel(function(at - d))) / (2 * step)
                for d in step * np.eye(len(at))
            ]
        )
        parts = {part: row @ slopes for part, row in self.parts.items()}
        return Uncertain(np.ravel(function(at)), parts)


def join(several: Sequence[Uncertain]) -> Uncertain:
    """Put numbers beside one another, (n₁ + n₂ + …,); an error that has the same name and draw in two of them is one."""
    values = np.concatenate([one.values for one in several])
    parts: dict[Part, np.ndarray] = {}
    start = 0
    for one in several:
        stop = start + len(one.values)
        for part, row in one.parts.items():
            parts.setdefault(part, np.zeros(len(values)))[start:stop] += row
        start = stop
    return Uncertain(values, parts)


@dataclass(frozen=True, eq=False)
class MeanSpectrum:
    """What is known of the mean of some pixels, band by band, (n,) each.

    Parameters
    ----------
    random : ndarray, (n,)
        Standard uncertainty by what pixels do not share: 0 where it is not known.
    wavelengths : ndarray, (n,), nm
        NaN where a band has none.
    gradient : ndarray, (2, n), per px, optional
        Slope of the mean in x and in y.
    lines : int
        Over how many lines of a scan the pixels lie.
    sigma : ndarray, (n,), optional
        Root mean square of the pixels' sigma; that of one pixel is `random`.
    """

    labels: Sequence[str]
    values: np.ndarray
    random: np.ndarray
    wavelengths: np.ndarray
    gradient: np.ndarray | None = None
    lines: int = 1
    sigma: np.ndarray | None = None

    @property
    def slope(self) -> np.ndarray:
        """Change of the value with wavelength, (n,), 1/nm; 0 where the bands do not say."""
        slope, known = np.zeros(len(self.values)), np.isfinite(self.wavelengths)
        order = np.flatnonzero(known)[np.argsort(self.wavelengths[known], kind="stable")]
        at = self.wavelengths[order]
        if len(at) > 1 and (np.diff(at) > 0).all():
            slope[order] = np.gradient(self.values[order], at)
        return slope


def uncertain_mean(
    mean: MeanSpectrum,
    sources: Iterable[ErrorSource],
    *,
    layer: str,
    camera: str = "",
    region: Hashable = 0,
) -> Uncertain:
    """Return the mean of some pixels with all that is known to make it uncertain.

    Sources common to a pixel are in `mean.random` and are left out; but for rows in units of sigma, which are shares of it that
    bands have in common, or a region, and leave the rest to each pixel and band. Two rows of one name in two units are two
    errors. `layer` and `camera` say whose errors they are; `region` names the pixels, whose noise is no other pixels'.

    >>> grey = MeanSpectrum(["R"], np.array([0.5]), np.array([0.003]), np.array([np.nan]))
    >>> white = ErrorSource("white", "relative", {"R": 0.01}, "campaign", all_bands=True)
    >>> uncertain_mean(grey, [white], layer="icon1/d80").sigma.round(5).tolist()
    [0.00583]
    """
    sources = [*sources]
    owners = dict.fromkeys(get_args(Extent), layer) | {"camera": camera or layer, "campaign": ""}
    parts: dict[Part, np.ndarray] = {}

    def one_by_one(row: np.ndarray, name: str, owner: str, draw: tuple[Hashable, ...]) -> None:
        for k in np.flatnonzero(row).tolist():
            parts[name, owner, (*draw, mean.labels[k])] = np.where(np.arange(len(row)) == k, row, 0)

    of_sigma = [_sizes(mean, source) for source in sources if source.unit == "sigma"]
    left = np.sqrt(np.maximum(1 - np.sum(np.square(of_sigma), 0), 0)) * mean.random
    one_by_one(left, "noise", layer, (region,))
    for source in sources:
        if source.common_to == "pixel" and source.unit != "sigma":
            continue
        sizes = _sizes(mean, source) / np.sqrt(mean.lines if source.common_to == "line" else 1)
        owner = source.owner or owners[source.common_to]
        place: Hashable = region if source.common_to in ("pixel", "line", "region") else ""
        for axis, row in enumerate(_coefficients(mean, source) * sizes):
            draw = (place, source.unit, axis)
            if not source.all_bands:
                one_by_one(row, source.name, owner, draw)
            elif row.any():
                parts[source.name, owner, draw] = row
    return Uncertain(np.asarray(mean.values, float), parts)


def _sizes(mean: MeanSpectrum, source: ErrorSource) -> np.ndarray:
    return np.array([source.size.get(label, 0.0) for label in mean.labels])


def _coefficients(mean: MeanSpectrum, source: ErrorSource) -> np.ndarray:
    """Return by how much an error of one unit moves the values, (1 or 2, n)."""
    values = np.asarray(mean.values, float)
    if source.unit == "sigma":
        whole = source.common_to != "pixel" and mean.sigma is not None
        return np.asarray(mean.sigma if whole else mean.random, float)[None]
    if source.unit == "px":
        return np.zeros((2, len(values))) if mean.gradient is None else mean.gradient
    if source.unit == "nm":
        return mean.slope[None]
    zero = np.array([source.zero_at.get(label, np.nan) for label in mean.labels])
    known = np.isfinite(zero) & (zero > 0)
    if source.unit == "relative":
        return (values * np.where(known, 1 - values / np.where(known, zero, 1.0), 1.0))[None]
    return np.where(known, zero - values, 1.0)[None]
