"""Samples of a database for spectral estimation: responses of some layers and spectra of another.

A sample is a pixel of paint that every layer saw well; pixels that are saturated, moved, outside or
show glare in any of their channels are left out, and so is gold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from math import ceil, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Flag, is_flagged
from levkas.core.problems import Problem, Refused, closest_match
from levkas.database.layout import LayerId
from levkas.estimation.training import ARRAYS, Training

if TYPE_CHECKING:
    import xarray

    from levkas.database.reader import Database

LEFT_OUT = Flag.OUTSIDE | Flag.SATURATED | Flag.GLARE | Flag.MOVED | Flag.NEAR
"""Flags of pixels that are neither trained on nor scored."""
ROWS = 128
"""Rows that are read at a time: a row of chunks of the Zarr layer."""
GOLD_RISE = 1.5
"""Least ratio of the reflectance at 600–680 nm to that at 430–490 nm of gold, whose edge is at 517 nm."""
BRIGHTENED = 1.25
"""Brightness under another lighting, over the painting's median, from which a pixel is taken for a mirror."""
RED_NM, BLUE_NM = (600.0, 680.0), (430.0, 490.0)
BLOCKS = 4
"""Spatial blocks along each side of a painting."""


class EstimationRefused(Refused):
    """Spectra cannot be estimated, or not be scored honestly, as requested."""


@dataclass(frozen=True)
class PaintSamples:
    """Pixels of paint of one painting with responses and spectra.

    Parameters
    ----------
    responses : ndarray, (n, channels)
    spectra : ndarray, (n, bands)
        Reflectance.
    response_sigma, spectrum_sigma : ndarray or None
        One standard deviation, shaped as the values.
    rows, columns : ndarray, (n,), int
        Places on the grid.
    """

    responses: np.ndarray
    spectra: np.ndarray
    response_sigma: np.ndarray | None
    spectrum_sigma: np.ndarray | None
    rows: np.ndarray
    columns: np.ndarray

    def __len__(self) -> int:
        return len(self.responses)

    def take(self, chosen: np.ndarray) -> PaintSamples:
        """Return the samples of some indices, or of a mask."""
        arrays = [getattr(self, field.name) for field in fields(self)]
        parts: list[Any] = [None if array is None else array[chosen] for array in arrays]
        return PaintSamples(*parts)

    def at_most(self, count: int) -> PaintSamples:
        """Return about `count` samples, evenly through the painting."""
        return (
            self if len(self) <= count else self.take(np.arange(0, len(self), len(self) // count))
        )

    def blocks(self) -> np.ndarray:
        """Return the number of each sample's spatial block, of `BLOCKS` along each side, (n,) int."""
        down, across = (
            np.minimum(BLOCKS * places // (int(places.max(initial=0)) + 1), BLOCKS - 1)
            for places in (self.rows, self.columns)
        )
        return np.asarray(BLOCKS * down + across)


@dataclass(frozen=True)
class SampleSource:
    """Where samples come from.

    Parameters
    ----------
    target : str
        Layer whose spectra are estimated, ``CAMERA`` or ``CAMERA@SETUP``.
    most : int
        Samples of a painting; the grid is thinned to a lattice where it has more pixels.
    """

    database: Database
    target: str
    most: int

    def step(self, name: str) -> int:
        """Return the spacing of the lattice on a painting, px."""
        height, width = self.layer(name, self.target).shape[:2]
        return max(1, ceil(sqrt(height * width / self.most)))

    def layer(self, name: str, layer: str) -> xarray.DataArray:
        """Open a layer of a painting."""
        key = LayerId.parse(name, layer)
        return self.database[name][key.camera, key.setup]

    def read(self, name: str, sources: Sequence[str]) -> PaintSamples:
        """Read the samples of a painting whose responses are the channels of some layers."""
        target = self.layer(name, self.target)
        layers = [self.layer(name, source) for source in sources]
        if any(layer.shape[:2] != target.shape[:2] for layer in layers):
            raise EstimationRefused(
                Problem(
                    "E_SIZE",
                    f"layers of {name} lie on different grids",
                    found=", ".join(
                        f"{s} {a.shape[:2]}" for s, a in zip(sources, layers, strict=True)
                    ),
                    expected=f"{self.target} {target.shape[:2]}",
                    fix="Build the database again.",
                )
            )
        step = self.step(name)
        lattice = [read_lattice(layer, step) for layer in (target, *layers)]
        good = np.logical_and.reduce(
            [values_good & np.isfinite(v).all(2) for v, values_good, _ in lattice]
        )
        if good.any():
            spectra = lattice[0][0][good].astype(np.float64)
            good[good] = ~(
                self._mirrors(name, step)[good]
                & _rises(spectra, np.asarray(target.wavelength.values, float))
            )
        if not good.any():
            raise EstimationRefused(
                Problem(
                    "E_NO_OVERLAP",
                    f"no pixel of paint of {name} is free of flags in all layers at once",
                    found=f"{', '.join(sources)} and {self.target}: masks without overlap",
                    expected="pixels in all layers without saturation, glare or movement",
                    fix="Check the flags of the layers, or remove one of them from --from.",
                )
            )
        rows, columns = (places * step for places in np.nonzero(good))
        responses = side_by_side(lattice[1:], 0, good)
        measured = side_by_side(lattice[:1], 0, good)
        assert responses is not None and measured is not None
        return PaintSamples(
            responses, measured, side_by_side(lattice[1:], 2, good), side_by_side(lattice[:1], 2, good),
            rows, columns,
        )  # fmt: skip

    def _mirrors(self, name: str, step: int) -> np.ndarray:
        """Return where a lamp is mirrored under any lighting, by gold where it rises to red, (rows, columns) of the lattice.

        Glare is; so is what another lighting makes brighter than it makes the median of the painting.
        """
        painting = self.database[name]
        found = []
        for camera, setup in painting.layers:
            flags = thinned(painting[camera, setup].levkas.flags, step)
            found.append(np.asarray(is_flagged(flags, Flag.GLARE).any(2)))
            if setup and (camera, "") in painting.layers:
                lit, default = (
                    thinned(painting[camera, s], step).mean(2, dtype=float) for s in (setup, "")
                )
                with np.errstate(invalid="ignore", divide="ignore"):
                    ratio = lit / default
                    found.append(ratio > BRIGHTENED * np.nanmedian(ratio))
        return np.logical_or.reduce(found)


def read_lattice(
    layer: xarray.DataArray, step: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return values, usable pixels and sigma of every `step`-th row and column of a layer."""
    sigma = layer.levkas.sigma
    left_out = np.asarray(is_flagged(thinned(layer.levkas.flags, step), LEFT_OUT).any(2))
    return thinned(layer, step), ~left_out, None if sigma is None else thinned(sigma, step)


def thinned(array: xarray.DataArray, step: int) -> np.ndarray:
    """Return every `step`-th row and column of an array, read by blocks of rows."""
    return np.concatenate([block[::step, ::step] for block in _blocks(array, step)])


def _blocks(array: xarray.DataArray, step: int) -> Iterator[np.ndarray]:
    """Yield blocks of rows, as many as a multiple of the step."""
    rows = -(-ROWS // step) * step
    for start in range(0, array.shape[0], rows):
        yield array.isel(y=slice(start, start + rows)).values


def side_by_side(
    lattice: Sequence[tuple[Any, ...]], part: int, good: np.ndarray
) -> np.ndarray | None:
    """Return one part of several layers side by side, (n, channels); None where a layer lacks it; no sigma is 0."""
    arrays = [layer[part] for layer in lattice]
    if any(array is None for array in arrays):
        return None
    values = np.concatenate([array[good] for array in arrays], axis=1).astype(np.float64)
    return np.where(np.isfinite(values), values, 0.0) if part else values


def _rises(spectra: np.ndarray, wavelengths: np.ndarray) -> np.ndarray:
    """Return which spectra rise from blue to red as gold's does."""
    red, blue = ((wavelengths >= low) & (wavelengths <= high) for low, high in (RED_NM, BLUE_NM))
    if not (red.any() and blue.any()):
        return np.ones(len(spectra), bool)
    return np.asarray(spectra[:, red].mean(1) > GOLD_RISE * spectra[:, blue].mean(1))


def training_of(parts: Sequence[PaintSamples]) -> Training:
    """Return the samples of several paintings, a group each, sigma where all have it; of one, a group a spatial block."""

    def joined(name: str) -> Any:
        arrays = [getattr(part, name) for part in parts]
        return None if any(a is None for a in arrays) else np.concatenate(arrays)

    groups = [np.full(len(part), number) for number, part in enumerate(parts)]
    if len(parts) == 1:
        groups = [parts[0].blocks()]
    responses, spectra, response_sigma, spectrum_sigma = map(joined, ARRAYS[:4])
    return Training(responses, spectra, response_sigma, spectrum_sigma, np.concatenate(groups))


# --- names ----------------------------------------------------------------------------------------


def require_layers(database: Database, layers: Sequence[str], field: str) -> list[str]:
    """Return the objects that have all of some layers of measured reflectance."""
    having: dict[str, set[str]] = {}
    for name in database:
        for camera, setup in database[name].layers:
            having.setdefault(LayerId(name, camera, setup).name, set()).add(name)
    problems = []
    for layer in layers:
        if layer not in having:
            problems.append(
                Problem(
                    "E_VALUE",
                    f"the database has no layer {layer!r}",
                    str(database.path),
                    field,
                    found=layer,
                    expected=", ".join(having),
                    fix=closest_match(layer, having),
                )
            )
            continue
        problems += _quantity_problems(database, sorted(having[layer])[0], layer, field)
    if problems:
        raise EstimationRefused(*problems)
    names = [name for name in database if all(name in having[layer] for layer in layers)]
    if not names:
        raise EstimationRefused(
            Problem(
                "E_MISSING",
                "no object has all of these layers",
                str(database.path),
                field,
                found=", ".join(layers),
            )
        )
    return names


def _quantity_problems(database: Database, name: str, layer: str, field: str) -> list[Problem]:
    key = LayerId.parse(name, layer)
    facts = database[name][key.camera, key.setup].attrs
    if facts.get("kind") == "estimated":
        what, fix = f"the layer {layer!r} was itself estimated", "Give a layer that was measured."
        return [
            Problem("E_ESTIMATED", what, str(database.path), field, layer, "a measurement", fix)
        ]
    if facts.get("quantity") == "reflectance":
        return []
    return [
        Problem(
            "E_QUANTITY",
            f"the layer {layer!r} is not in reflectance",
            str(database.path),
            field,
            found=str(facts.get("quantity")),
            expected="reflectance",
            fix="Declare dark and white frames of the camera in campaign.toml and build again.",
        )
    ]
