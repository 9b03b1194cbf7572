"""Glare maps: how bright varnish and gold get beside a white board in the object's plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.irradiance import illuminate, light_of
from levkas.planning.microfacet import AIR, facet_lobe, fresnel, gold_index
from levkas.planning.texture import slope_nodes

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting
    from levkas.planning.surface import Surface
    from levkas.planning.tables import ObjectKeys, Sheets


@dataclass(frozen=True, eq=False)
class Glare:
    """Specular light over a white board's at the same place, arrays (rows, columns) or None."""

    varnish: np.ndarray | None
    gold: np.ndarray | None


def glare(
    thing: ObjectKeys, surface: Surface, lighting: Lighting, eye: np.ndarray, sheets: Sheets,
    *, model: str = "ggx",
) -> Glare:  # fmt: skip
    """Return the glare of varnish and gold over an object.

    Parameters
    ----------
    thing : ObjectKeys
    surface : Surface
    lighting : Lighting
    eye : ndarray, (3,)
        Where the camera stands, mm.
    sheets : Sheets
        Under crossed polarisers specular light is left as their leak.

    Returns
    -------
    glare : Glare
        1 is as bright as white. Facets are GGX unless `model` is ``"beckmann"``.
    """
    flat = np.zeros_like(surface.normals)
    flat[..., 2] = 1
    white = illuminate(lighting.lamps, surface.points, flat)
    found: list[np.ndarray | None] = []
    for coat, index in ((thing.varnish, None), (thing.gold, gold_index())):
        if coat is None:
            found.append(None)
            continue
        n = coat.index / AIR if index is None else index  # type: ignore[union-attr]
        light = _specular(surface, lighting, eye, coat.roughness, n, model)
        if lighting.crossed:
            light = light * sheets.leak * 2  # the diffuse light loses half, this all but the leak
        found.append(light / np.maximum(white, 1e-30))
    return Glare(*found)


def _specular(
    surface: Surface, lighting: Lighting, eye: np.ndarray, roughness: float, index: complex,
    model: str,
) -> np.ndarray:  # fmt: skip
    """Return π times the radiance of facets, in the unit of the irradiance."""
    n = surface.normals
    view = eye - surface.points
    view = view / np.linalg.norm(view, axis=-1, keepdims=True)
    to_eye = (n * view).sum(-1)
    total = np.zeros(to_eye.shape)
    for lamp in lighting.lamps:
        strength, towards = light_of(lamp, surface.points)
        half = towards + view
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        incident = (n * towards).sum(-1)
        s, p = fresnel((half * towards).sum(-1), index)
        mirrored = {"s": s, "p": p, None: (s + p) / 2}[lamp.polariser]
        lobe = facet_lobe(
            (n * half).sum(-1), incident, np.broadcast_to(to_eye, incident.shape), roughness,
            model=model,
        )  # fmt: skip
        total = total + (mirrored * lobe * np.maximum(incident, 0) * strength).sum(0)
    return total


def rough_texture(
    thing: ObjectKeys, lighting: Lighting, eye: np.ndarray, sheets: Sheets, *, paint: float = 0.2
) -> float:
    """Return the contrast of relief at the object's middle, specular light of the varnish included.

    Slopes are normal with the object's `relief_slope`; the contrast is spread over mean of what the
    camera gets from paint of reflectance `paint`.
    """
    slopes, weights = slope_nodes(thing.relief_slope)
    normals = np.concatenate([-slopes, np.ones((len(slopes), 1))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    from levkas.planning.surface import Surface

    spots = Surface(np.zeros(1), np.zeros(1), np.zeros_like(normals), normals)
    shading = illuminate(lighting.lamps, spots.points, normals)
    total = paint * shading
    if thing.varnish is not None:
        index = thing.varnish.index / AIR
        mirror = _specular(spots, lighting, eye, thing.varnish.roughness, index, "ggx")
        total = total + mirror * (2 * sheets.leak if lighting.crossed else 1.0)
    mean = weights @ total
    return float(np.sqrt(weights @ (total - mean) ** 2) / mean)
