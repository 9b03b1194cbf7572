"""What lies beside the pixels of a layer: flags, sigma, maps and regions, for any array that still says where its pixels lie."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray

from levkas.core.problems import Problem, Refused
from levkas.database.layout import LayerId
from levkas.database.opening import has_sigma, open_layer, place_of

if TYPE_CHECKING:
    from levkas.calibration.error_sources import Uncertain
    from levkas.colour.illuminants import Light
    from levkas.database.pixel_frames import FrameMap
    from levkas.database.region_uncertainty import Of
    from levkas.database.regions import Region

LEAST_COVERAGE = 0.9
"""Of the weight of X, Y and Z, for bands to have a colour."""
SAMPLES = 16
"""Rows and columns that are compared to know whether values are those of the layer; a change of all, or of a large part, is found."""


class LayerAccessor:
    """``array.levkas``: what lies beside the pixels of an array of a layer.

    An array says by its coordinates where its pixels come from (`database`, `layer`) and where in the grid they lie
    (`x`, `y`, `band`). So flags, maps and regions are there for whatever keeps these: selections, crops, copies,
    transpositions, other types and chunks, `where`, arithmetic with numbers.

    Parameters
    ----------
    array : xarray.DataArray
    """

    def __init__(self, array: xarray.DataArray) -> None:
        self._array = array

    @property
    def flags(self) -> xarray.DataArray:
        """The flags of these pixels, uint8, in the order of the array: bits of `levkas.core.cube.Flag`."""
        return self._beside("flags")

    @property
    def sigma(self) -> xarray.DataArray | None:
        """One standard deviation of these pixels' random part; None where it is not known.

        Raises
        ------
        DatabaseRefused, TiffRefused
            Where the layer has one that is damaged or missing.
        ValueError
            Where the values are not those of the layer any more: sigma is not that of 100 times the values.
        """
        if not has_sigma(*self.place):
            return None
        if not self._is_unchanged():
            raise ValueError(
                "the values of this array were computed, and sigma is that of the values of the layer: take it of "
                "the layer as it was opened, and propagate it"
            )
        return self._beside("sigma")

    @property
    def preview(self) -> xarray.DataArray:
        """The published picture of these pixels, sRGB, uint8 (y, x, rgb) or (y, x)."""
        from PIL import Image

        root, layer = self.place
        with Image.open(io.BytesIO((root / f"{layer.path}.png").read_bytes())) as picture:
            pixels = np.asarray(picture)
        dims = ("y", "x", "rgb")[: pixels.ndim]
        whole = xarray.DataArray(pixels, dims=dims, name="preview")
        return self._selected(whole, ("y", "x"))

    def transform(self, source: str, target: str) -> FrameMap:
        """Return the map between two frames of pixels of the object; of ``grid`` they are the x and y of this array.

        Raises
        ------
        MappingRefused
            Where a frame is not there, or its registration was refused.
        ValueError
            Where x or y of this array are lost, or are not the grid's.
        """
        from levkas.database.pixel_frames import find_map

        root, layer = self.place
        whole = open_layer(root, layer)
        for axis in ("x", "y"):
            _positions(self._array, whole, axis)
        return find_map(root, layer.object, source, target)

    def region(
        self,
        polygon: Sequence[tuple[float, float]] | None = None,
        *,
        rectangle: tuple[float, float, float, float] | None = None,
        circle: tuple[float, float, float] | None = None,
    ) -> xarray.Dataset:
        """Return mean, standard deviation and number of sound pixels of a region, band by band.

        Parameters
        ----------
        polygon : sequence of (x, y), px
            Corners, by the x and y of this array; a pixel belongs to it where its centre lies within.
        rectangle : (x0, y0, x1, y1), px
            From pixel to pixel, both included.
        circle : (x, y, radius), px

        Returns
        -------
        statistics : xarray.Dataset
            As of `levkas.database.regions.region_statistics`.

        Raises
        ------
        RegionRefused
            ``E_REGION`` where the region is none, or no pixel lies within.
        """
        from levkas.database.regions import make_region, region_statistics

        region = make_region(polygon, rectangle, circle)
        layer, flags = (_with_bands(array) for array in (self._array, self.flags))
        return region_statistics(layer, flags, region)

    def uncertainty(
        self,
        polygon: Sequence[tuple[float, float]] | None = None,
        *,
        rectangle: tuple[float, float, float, float] | None = None,
        circle: tuple[float, float, float] | None = None,
        bands: Sequence[str] | None = None,
        of: Of = "mean",
        beside: Mapping[str, Any] | None = None,
    ) -> xarray.Dataset:
        """Return what is read from a region with its uncertainty, random and common errors combined.

        Parameters
        ----------
        polygon, rectangle, circle
            As of `region`.
        bands : sequence of str, optional
            Labels; all by default.
        of : {"mean", "difference", "ratio", "delta_e"}
            The mean of each band; the difference or ratio of two bands, or, with `beside`, of two regions band by band; the colour
            difference ΔE2000 of two regions under D65.
        beside : mapping, optional
            The second region: ``{"rectangle": (0, 0, 9, 9)}``.

        Returns
        -------
        numbers : xarray.Dataset
            Over ``band``: ``value``; ``u``, its standard uncertainty; ``U``, expanded with k = 2; ``u_random`` and ``u_common``, of the
            pixels' own noise and of what they share; ``u_by_source``. The attribute ``not_known`` names the sources that
            nothing is known of, and that are not in it.

        Raises
        ------
        RegionRefused
            ``E_REGION`` as of `region`, or where these pixels are not neighbours in the grid; ``E_VALUE`` where that cannot
            be made of these bands.

        Notes
        -----
        First order in all errors ([jcgm2008]_). An error that two numbers share leaves their ratio.
        """
        from levkas.database.region_uncertainty import combine, to_dataset
        from levkas.database.regions import make_region

        regions = [make_region(polygon, rectangle, circle)]
        if beside is not None:
            regions.append(
                make_region(*(beside.get(k) for k in ("polygon", "rectangle", "circle")))
            )
        array = _with_bands(self._array)
        means, unknown = _uncertain_means(array, *self.place, regions)
        labels = [str(label) for label in array.band.values]
        wavelengths = np.atleast_1d(array.wavelength.values).astype(float)
        if bands is not None:  # of all bands before, which show how steep the spectrum is
            some = [
                int(np.flatnonzero(array.band.values == band)[0])
                for band in array.sel(band=[*bands]).band.values
            ]
            means = [one.pick(some) for one in means]
            labels, wavelengths = [labels[k] for k in some], wavelengths[some]
        made, names = combine(
            of, labels, wavelengths, means[0], means[1] if beside is not None else None
        )
        return to_dataset(made, names, unknown)

    def render(self, light: Light = "D65", *, adapted: bool = True) -> xarray.DataArray:
        """Show these pixels as they look under a light, sRGB, uint8 (…, rgb).

        Parameters
        ----------
        light : str or (wavelengths, powers)
            ``"D65"``, ``"A"`` and the others of `levkas.colour.illuminants`, or a spectrum, nm.
        adapted : bool
            Whether the eye is used to the light, so that white is white, or sees it beside a D65 display.

        Raises
        ------
        Refused
            ``E_VALUE`` where these are not reflectances of bands through the visible; `preview` shows any layer.
        """
        from levkas.colour.relighting import relight

        return _by_pixel(
            self._array, "rgb", lambda v, nm: relight(v, nm, light, adapted=adapted), [*"rgb"]
        )

    def lab(self, light: Light = "D65") -> xarray.DataArray:
        """Return CIELAB of these pixels under a light, (…, lab), for the 2° observer; NaN where a band has no value.

        Raises
        ------
        Refused
            ``E_VALUE`` as of `render`.
        """
        from levkas.colour.gamut import lab_of

        return _by_pixel(self._array, "lab", lambda v, nm: lab_of(v, nm, light), ["L", "a", "b"])

    def delta_e(self, other: xarray.DataArray, light: Light = "D65") -> xarray.DataArray:
        """Return the colour difference ΔE2000 of these pixels from others, (…).

        Parameters
        ----------
        other : xarray.DataArray
            Pixels of another layer or date on the same grid, aligned by x and y; or one spectrum, with ``wavelength``.
        light : as of `render`

        Raises
        ------
        Refused
            ``E_VALUE`` as of `render`.
        """
        from levkas.colour.gamut import delta_e_2000

        one, two = xarray.broadcast(
            *xarray.align(self.lab(light), other.levkas.lab(light), join="inner")
        )
        made = delta_e_2000(
            one.transpose(..., "lab").values, two.transpose(*one.dims[:-1], "lab").values
        )
        return xarray.DataArray(made, _places_of(one), one.dims[:-1], "delta_e")

    def spectral_angle(self, reference: xarray.DataArray) -> xarray.DataArray:
        """Return the angle between each pixel's spectrum and a reference, (…), radians: small where the material is alike.

        Parameters
        ----------
        reference : xarray.DataArray, (wavelength,) or (band,)
            Of a spectral library (`levkas.read_spectra`), or a pixel; linear between its wavelengths. Bands beyond them are
            left out.

        Raises
        ------
        Refused
            ``E_VALUE`` where fewer than two bands lie within the reference, or bands have no wavelength.

        Notes
        -----
        Kruse et al. 1993 (10.1016/0034-4257(93)90013-N).
        """
        from levkas.colour.gamut import spectral_angle

        spectrum = reference.squeeze(drop=True).dropna(reference.squeeze(drop=True).dims[0])
        known, values = np.asarray(spectrum["wavelength"].values, float), spectrum.values
        order = np.argsort(known, kind="stable")

        def angle(pixels: np.ndarray, nm: np.ndarray) -> np.ndarray:
            within = (nm >= known.min()) & (nm <= known.max())
            if within.sum() < 2:
                raise _no_colours(
                    self._array, f"bands within {known.min():g} to {known.max():g} nm"
                )
            wanted = np.interp(nm[within], known[order], values[order])
            return spectral_angle(pixels[..., within], wanted)

        return _by_pixel(self._array, None, angle)

    @property
    def place(self) -> tuple[Path, LayerId]:
        """Database and layer of these pixels; raises ValueError where that is lost."""
        place = place_of(self._array)
        if place is None:
            raise ValueError(
                "this array does not say of which layer its pixels are: it was computed from several, or its "
                "coordinates database and layer are lost; take the layer as it was opened"
            )
        return place

    def _beside(self, kind: str) -> xarray.DataArray:
        whole = open_layer(*self.place, kind)
        made = self._selected(whole, ("y", "x", "band"))
        if kind == "sigma" and "units" in self._array.attrs:
            made.attrs["units"] = self._array.attrs["units"]
        return xarray.DataArray(made.variable, self._array.coords, name=kind)

    def _is_unchanged(self) -> bool:
        """Return whether the values are those of the layer, in whatever type; NaN may stand for any."""
        root, layer = self.place
        if self._array.encoding.get("source") == f"{root}/{layer.object}/{layer.name}":
            return True
        steps = {d: slice(None, None, max(1, n // SAMPLES)) for d, n in self._array.sizes.items()}
        part = self._array.isel({d: steps[d] for d in ("x", "y") if d in steps})
        own, published = part.values, part.levkas._beside("values").values
        with np.errstate(invalid="ignore"):
            same = (own == published.astype(own.dtype)) | (own != own)
        return bool(np.all(same))

    def _selected(self, whole: xarray.DataArray, axes: tuple[str, ...]) -> xarray.DataArray:
        """Return the pixels of a whole layer that lie where those of the array do, in its order of dimensions."""
        picked = whole.isel({axis: _positions(self._array, whole, axis) for axis in axes})
        order = [dim for dim in self._array.dims if dim in picked.dims]
        return picked.transpose(*order, ...)


def _by_pixel(
    array: xarray.DataArray,
    axis: str | None,
    compute: Callable[[np.ndarray, np.ndarray], np.ndarray],
    labels: Sequence[str] = (),
) -> xarray.DataArray:
    """Compute something of the spectrum of every pixel, by its values and wavelengths, nm; along `axis`, or one number each."""
    from levkas.colour.srgb import visible_coverage

    bands = next(
        (
            array[name].dims[0]
            for name in ("wavelength", "band")
            if name in array.coords and array[name].dims
        ),
        None,
    )
    nm = (
        np.asarray(array["wavelength"].values, float)
        if "wavelength" in array.coords
        else np.array([])
    )
    coloured = axis is not None
    if bands is None or not np.isfinite(nm).all():
        raise _no_colours(array, "bands with wavelengths")
    if array.attrs.get("quantity", "reflectance") != "reflectance":
        raise _no_colours(array, "reflectance")
    if coloured and (len(nm) < 3 or visible_coverage(nm) < LEAST_COVERAGE):
        raise _no_colours(array, "bands through the visible")
    moved = array.transpose(..., bands)
    made = compute(np.asarray(moved.values, float), nm)
    dims = moved.dims[:-1] + ((axis,) if axis else ())
    places = _places_of(moved) | ({axis: list(labels)} if axis else {})
    return xarray.DataArray(made, places, dims, name=axis or "spectral_angle")


def _places_of(array: xarray.DataArray) -> dict[str, Any]:
    """Return the coordinates of an array that say where its pixels lie."""
    return {name: array.coords[name] for name in ("y", "x") if name in array.coords}


def _no_colours(array: xarray.DataArray, expected: str) -> Refused:
    nm = (
        np.atleast_1d(np.asarray(array["wavelength"].values, float))
        if "wavelength" in array.coords
        else np.array([np.nan])
    )
    known = nm[np.isfinite(nm)]
    span = f"{known.min():g} to {known.max():g} nm" if len(known) else "no wavelengths"
    found = f"{array.attrs.get('quantity', 'values')}, {len(nm)} bands, {span}"
    what = "this cannot be computed of these bands"
    name = str(array.coords["layer"].values) if "layer" in array.coords else None
    return Refused(Problem("E_VALUE", what, name, "wavelength", found, expected))


def _uncertain_means(
    array: xarray.DataArray, root: Path, layer: LayerId, regions: Sequence[Region]
) -> tuple[list[Uncertain], list[str]]:
    """Return the means of regions with their errors, and the sources that nothing is known of."""
    from levkas.core.cube import Band
    from levkas.database import region_uncertainty as found
    from levkas.database.described import Pixels

    budget = found.read_budget(root, layer)
    beside = array.levkas
    flags, sigma = (
        None if one is None else _with_bands(one) for one in (beside.flags, beside.sigma)
    )
    assert flags is not None
    labels = [str(label) for label in array.band.values]
    corner = _corner(array)
    last = (array.x.values[-1], array.y.values[-1])
    centres = [
        np.clip(np.reshape(region.bounds, (2, 2)).mean(0), corner, last) for region in regions
    ]
    known = found.position_sigmas(root, layer, labels, np.array(centres))
    nm = np.atleast_1d(array.wavelength.values).astype(float)
    bands = [Band(label, float(at)) for label, at in zip(labels, nm, strict=True)]
    means = []
    for region, sigmas in zip(regions, known, strict=True):
        own = replace(region, vertices=region.vertices - corner)
        x0, y0, x1, y1 = own.bounds
        left, top = max(0, int(np.floor(x0)) - 1), max(0, int(np.floor(y0)) - 1)
        part = {
            "x": slice(left, max(left, int(np.ceil(x1)) + 2)),
            "y": slice(top, max(top, int(np.ceil(y1)) + 2)),
        }
        noise = None if sigma is None else _rows_of(sigma, part)
        pixels = Pixels(_rows_of(array, part), _rows_of(flags, part), noise)
        moved = replace(own, vertices=own.vertices - (left, top))
        mean = found.mean_of_region(pixels, bands, moved, budget.correlation)
        here = found.with_place(budget, labels, sigmas)
        means.append(found.uncertain_region(mean, here, layer, region.vertices.tolist()))
    unknown = [row.name for row in budget.sources if row.basis == "unknown"]
    return means, unknown if budget.sources else [found.NO_BUDGET]


def _rows_of(array: xarray.DataArray, part: Mapping[str, slice]) -> np.ndarray:
    return np.asarray(array.isel(part).transpose("y", "x", "band").values)


def _corner(array: xarray.DataArray) -> np.ndarray:
    """Return x and y of the first pixel; raises RegionRefused where pixels are no neighbours: noise and slopes are those of neighbours."""
    from levkas.database.regions import RegionRefused

    places = [array[axis] for axis in ("x", "y")]
    for at in places:
        if at.dims != (at.name,) or not at.size or (np.diff(at.values) != 1).any():
            why = "these pixels are not neighbours in the grid"
            fix = "Take the uncertainty of the layer before it is thinned, turned or joined."
            raise RegionRefused(Problem("E_REGION", why, field=str(at.name), fix=fix))
    return np.array([float(at.values[0]) for at in places])


def _with_bands(array: xarray.DataArray) -> xarray.DataArray:
    """Return an array with the dimension band, which a selected band or another coordinate stands for."""
    if "band" in array.dims:
        return array
    if array.band.dims:
        return array.swap_dims({array.band.dims[0]: "band"})
    return array.expand_dims("band", -1)


def _positions(array: xarray.DataArray, whole: xarray.DataArray, axis: str) -> Any:
    """Return where the pixels of an array lie along an axis of the whole layer.

    Raises ValueError where its coordinate is lost, or is none of the layer's.
    """
    if axis not in array.coords:
        raise ValueError(
            f"this array has lost the coordinate {axis}, which says of which pixels it is"
        )
    known = array.coords[axis]
    places = whole.get_index(axis).get_indexer(np.ravel(known.values)).reshape(known.shape)
    if (places < 0).any():
        raise ValueError(f"the coordinate {axis} of this array is not that of the layer's pixels")
    steps = np.unique(np.diff(places)) if known.dims == (axis,) else np.empty(0, int)
    if len(steps) == 1 and steps[0] > 0:  # by which fewer pixels are read than by a list
        return slice(int(places[0]), int(places[-1]) + 1, int(steps[0]))
    return xarray.DataArray(places, dims=known.dims) if known.dims else int(places)
