"""What lies beside the pixels of a layer: flags, sigma, maps and regions, and what is computed of their spectra."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray

from levkas.core.problems import Problem, Refused
from levkas.database.layout import LayerId
from levkas.database.opening import has_sigma, open_layer, place_of
from levkas.database.regions import RegionRefused, make_region, region_statistics

if TYPE_CHECKING:
    from levkas.colour.illuminants import Light
    from levkas.database.pixel_frames import FrameMap
    from levkas.database.region_uncertainty import Of

LEAST_COVERAGE = 0.9
"""Of the weight of X, Y and Z, for bands to have a colour."""
SAMPLES = 16
"""Rows and columns that are compared to know whether values are those of the layer; a change of all, or of a large part, is found."""


class LayerAccessor:
    """``array.levkas``: what lies beside the pixels of an array of a layer.

    An array says by its coordinates where its pixels come from (`database`, `layer`) and where in the grid they lie
    (`x`, `y`, `band`). So flags, maps and regions are there for whatever keeps these: selections, crops, copies,
    transpositions, other types and chunks, `where`, arithmetic with numbers.
    """

    def __init__(self, array: xarray.DataArray) -> None:
        self._array = array

    @property
    def place(self) -> tuple[Path, LayerId]:
        """Database and layer of these pixels; raises ValueError where that is lost."""
        place = place_of(self._array)
        if place is None:
            raise ValueError(
                "this array has lost its coordinates database and layer; take the layer as it was opened"
            )
        return place

    @property
    def flags(self) -> xarray.DataArray:
        """The flags of these pixels, uint8, in the order of the array: bits of `levkas.core.cube.Flag`."""
        return self._beside("flags")

    @property
    def sigma(self) -> xarray.DataArray | None:
        """One standard deviation of these pixels' random part; None where it is not known.

        Raises DatabaseRefused or TiffRefused where the layer has one that is damaged or missing; ValueError where the
        values were computed, of which sigma is not.
        """
        if not has_sigma(*self.place):
            return None
        if not self._is_unchanged():
            raise ValueError(
                "the values of this array were computed: take sigma of the layer as it was opened"
            )
        return self._beside("sigma")

    def transform(self, source: str, target: str) -> FrameMap:
        """Return the map between two frames of pixels of the object; of ``grid`` they are the x and y of this array.

        Raises MappingRefused where a frame is not there, or its registration was refused; ValueError where x or y of this
        array are lost, or are not the grid's.
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

        Of `polygon`, corners (x, y) by the x and y of this array, a pixel belongs to it where its centre lies within;
        `rectangle` is (x0, y0, x1, y1), both included, `circle` (x, y, radius). Raises RegionRefused: ``E_REGION`` where the
        region is none, or no pixel lies within.
        """
        region = make_region(polygon, rectangle, circle)
        return region_statistics(_with_bands(self._array), _with_bands(self.flags), region)

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
        """Return what is read from a region with its uncertainty, random and common errors combined to first order ([jcgm2008]_).

        Regions are as of `region`; `beside` is a second one, ``{"rectangle": (0, 0, 9, 9)}``; `bands` are labels, all by default.
        `of` them is read the mean of each band; the difference or ratio of two bands, or of two regions band by band, which an
        error that both share leaves; or the colour difference ΔE2000 of two regions under D65.

        Over ``band``: ``value``; ``u``, its standard uncertainty; ``U``, expanded with k = 2; ``u_random`` and ``u_common``, of the
        pixels' own noise and of what they share; ``u_by_source``. The attribute ``not_known`` names the sources that nothing is
        known of, and that are not in it. Raises RegionRefused: ``E_REGION`` as of `region`, or where these pixels are not
        neighbours in the grid; ``E_VALUE`` where that cannot be made of these bands.
        """
        from levkas.database import region_uncertainty as regional

        regions = [make_region(polygon, rectangle, circle)]
        if beside is not None:
            second = (beside.get(kind) for kind in ("polygon", "rectangle", "circle"))
            regions.append(make_region(*second))
        array = _with_bands(self._array)
        _require_neighbours(array)
        flags = _with_bands(self.flags)
        sigma = None if (noise := self.sigma) is None else _with_bands(noise)
        means, budget = regional.uncertain_means(*self.place, (array, flags, sigma), regions)
        labels = [str(label) for label in array.band.values]
        wavelengths = np.atleast_1d(array.wavelength.values).astype(float)
        if bands is not None:  # of all bands before, which show how steep the spectrum is
            chosen = array.sel(band=[*bands]).band.values
            some = [labels.index(str(band)) for band in chosen]
            means = [one.pick(some) for one in means]
            labels, wavelengths = [labels[k] for k in some], wavelengths[some]
        made, names = regional.combine(of, labels, wavelengths, means[0], *means[1:])
        unknown = [row.name for row in budget.sources if row.basis == "unknown"]
        unknown = unknown if budget.sources else [regional.NO_BUDGET]
        return regional.to_dataset(made, names, unknown)

    def render(self, light: Light = "D65", *, adapted: bool = True) -> xarray.DataArray:
        """Show these pixels as they look under a light, sRGB, uint8 (…, rgb).

        `light` is a name of `levkas.colour.illuminants` or a spectrum, (wavelengths in nm, powers). `adapted`: the eye is used
        to the light, so that white is white, or sees it beside a D65 display. Raises Refused, ``E_VALUE``, where these are not
        reflectances of bands through the visible.
        """
        from levkas.colour.relighting import relight

        shown = partial(relight, light=light, adapted=adapted)
        return _by_pixel(self._array, shown, rgb=[*"rgb"])

    def lab(self, light: Light = "D65") -> xarray.DataArray:
        """Return CIELAB of these pixels under a light, (…, lab), for the 2° observer; NaN where a band has no value. Raises Refused as `render`."""
        from levkas.colour.gamut import lab_of

        return _by_pixel(self._array, partial(lab_of, light=light), lab=[*"Lab"])

    def delta_e(self, other: xarray.DataArray, light: Light = "D65") -> xarray.DataArray:
        """Return the colour difference ΔE2000 of these pixels from others, (…). Raises Refused as `render`.

        `other`: pixels of another layer or date on the same grid, aligned by x and y; or one spectrum, with ``wavelength``.
        """
        from levkas.colour.gamut import delta_e_2000

        both, core = (self.lab(light), other.levkas.lab(light)), [["lab"], ["lab"]]
        apart = xarray.apply_ufunc(delta_e_2000, *both, input_core_dims=core, join="inner")
        return _named(apart, "delta_e")

    def spectral_angle(self, reference: xarray.DataArray) -> xarray.DataArray:
        """Return the angle between each pixel's spectrum and a reference, (…), radians: small where the material is alike.

        `reference`, (wavelength,) or (band,), is of a spectral library (`levkas.read_spectra`), or a pixel; linear between its
        wavelengths, bands beyond them are left out. Raises Refused, ``E_VALUE``, where fewer than two bands lie within it, or
        bands have no wavelength. Kruse et al. 1993 (10.1016/0034-4257(93)90013-N).
        """
        from levkas.colour.gamut import spectral_angle

        spectrum = reference.squeeze(drop=True)
        spectrum = spectrum.dropna(spectrum.dims[0]).sortby("wavelength")
        known, values = np.asarray(spectrum["wavelength"].values, float), spectrum.values

        def angle(pixels: np.ndarray, nm: np.ndarray) -> np.ndarray:
            within = (nm >= known[0]) & (nm <= known[-1])
            if within.sum() < 2:
                raise _no_colours(self._array, f"bands within {known[0]:g} to {known[-1]:g} nm")
            return spectral_angle(pixels[..., within], np.interp(nm[within], known, values))

        return _named(_by_pixel(self._array, angle), "spectral_angle")

    def _beside(self, kind: str) -> xarray.DataArray:
        whole = open_layer(*self.place, kind)
        picked = whole.isel({axis: _positions(self._array, whole, axis) for axis in whole.dims})
        order = [dim for dim in self._array.dims if dim in picked.dims]
        made = picked.transpose(*order, ...)
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
            return bool(np.all((own == published.astype(own.dtype)) | (own != own)))


def _positions(array: xarray.DataArray, whole: xarray.DataArray, axis: Hashable) -> Any:
    """Return where the pixels of an array lie along an axis of the whole layer; raises ValueError where its coordinate does not say it."""
    if axis not in array.coords:
        raise ValueError(f"this array has lost the coordinate {axis}")
    known = array.coords[axis]
    places = whole.get_index(axis).get_indexer(np.ravel(known.values)).reshape(known.shape)
    if (places < 0).any():
        raise ValueError(f"the coordinate {axis} of this array is not that of the layer's pixels")
    steps = np.unique(np.diff(places)) if known.dims == (axis,) else np.empty(0, int)
    if len(steps) == 1 and steps[0] > 0:  # by which fewer pixels are read than by a list
        return slice(int(places[0]), int(places[-1]) + 1, int(steps[0]))
    return xarray.DataArray(places, dims=known.dims) if known.dims else int(places)


def _with_bands(array: xarray.DataArray) -> xarray.DataArray:
    """Return an array with the dimension band, which a selected band or another coordinate stands for."""
    if "band" in array.dims:
        return array
    if array.band.dims:
        return array.swap_dims({array.band.dims[0]: "band"})
    return array.expand_dims("band", -1)


def _require_neighbours(array: xarray.DataArray) -> None:
    """Raise RegionRefused where pixels are no neighbours: noise and slopes are those of neighbours."""
    for at in (array["x"], array["y"]):
        if at.dims != (at.name,) or not at.size or (np.diff(at.values) != 1).any():
            why = "these pixels are not neighbours in the grid"
            fix = "Take the uncertainty of the layer before it is thinned, turned or joined."
            raise RegionRefused(Problem("E_REGION", why, field=str(at.name), fix=fix))


def _by_pixel(
    array: xarray.DataArray,
    compute: Callable[[np.ndarray, np.ndarray], np.ndarray],
    **axis: list[str],
) -> xarray.DataArray:
    """Compute something of the spectrum of every pixel, by its values and wavelengths, nm; a number each, or several along an axis: a colour."""
    from levkas.colour.srgb import visible_coverage

    nm = _wavelengths(array)
    if not len(nm) or not np.isfinite(nm).all() or not array["wavelength"].dims:
        raise _no_colours(array, "bands with wavelengths")
    if array.attrs.get("quantity", "reflectance") != "reflectance":
        raise _no_colours(array, "reflectance")
    if axis and (len(nm) < 3 or visible_coverage(nm) < LEAST_COVERAGE):
        raise _no_colours(array, "bands through the visible")
    made = xarray.apply_ufunc(
        lambda values: compute(np.asarray(values, float), nm),
        array.compute(),
        input_core_dims=[array["wavelength"].dims],
        output_core_dims=[[*axis]],
    )
    return _named(made.assign_coords(axis), "".join(axis))


def _named(array: xarray.DataArray, name: str) -> xarray.DataArray:
    """Return what was computed of a layer, whose name, facts and place it does not have."""
    return array.drop_vars(("database", "layer"), errors="ignore").drop_attrs().rename(name)


def _wavelengths(array: xarray.DataArray) -> np.ndarray:
    if "wavelength" not in array.coords:
        return np.zeros(0)
    return np.atleast_1d(np.asarray(array["wavelength"].values, float))


def _no_colours(array: xarray.DataArray, expected: str) -> Refused:
    nm = _wavelengths(array)
    known = nm[np.isfinite(nm)]
    span = f"{known.min():g} to {known.max():g} nm" if len(known) else "no wavelengths"
    found = f"{array.attrs.get('quantity', 'values')}, {len(nm)} bands, {span}"
    what = "this cannot be computed of these bands"
    name = str(array.coords["layer"].values) if "layer" in array.coords else None
    return Refused(Problem("E_VALUE", what, name, "wavelength", found, expected))
