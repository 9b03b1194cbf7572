"""A target reduced to means of blocks of its pixels: pictures too fine for the reference, and scans too large to be held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration.bands import BandImage
from levkas.registration.record import Registration
from levkas.registration.request import Request

FACTOR = 4
"""Px a side in one of a target that is too fine: macro photographs of up to 32 px to one of the reference are registered."""
LEAST_SIDE = 250
"""Px, of the reduced picture of a macro photograph that shows enough to be found by key points."""


def reduce_target(request: Request, factor: int = FACTOR) -> Request:
    """Return the request with the target's pictures reduced, and what is stated in px of them."""
    grow = Affine.of_box(0, 0, factor)
    align: Mapping[str, Any] = {
        sensor: Composed(
            grow, one if callable(one) else Affine(np.asarray(one, float)), Inverse(grow)
        )
        for sensor, one in request.align.items()
    }
    region = request.target_region
    return replace(
        request,
        target=[reduced(image, factor) for image in request.target],
        given={sensor: pairs.reduced(factor) for sensor, pairs in request.given.items()},
        align=align,
        target_region=None if region is None else [side / factor for side in region],
    )


def reduced(image: BandImage, factor: int) -> BandImage:
    """Return the means of blocks of valid px; one in which less than half are valid is not.

    Examples
    --------
    >>> reduced(BandImage.of("1", np.arange(4.0).reshape(2, 2)), 2).values
    array([[1.5]], dtype=float32)
    """
    height, width = (side // factor for side in image.values.shape)
    inside = np.s_[: height * factor, : width * factor]
    blocks = (height, factor, width, factor)
    valid = image.valid[inside].reshape(blocks)
    count = valid.sum((1, 3))
    total = image.values[inside].reshape(blocks).sum((1, 3), where=valid)
    values = (total / np.maximum(count, 1)).astype(np.float32)
    return replace(image, values=values, valid=count >= factor**2 / 2, sites=None)


def enlarged(found: Registration, factor: int = FACTOR) -> Registration:
    """Return a registration of reduced pictures as one of native pixels."""
    grow = Affine.of_box(0, 0, factor)
    errors = dict(found.errors)
    if "check_points" in errors:
        errors["check_points"] = [
            one | {"target": grow(np.array([one["target"]]))[0].tolist()}
            for one in errors["check_points"]
        ]
    return replace(
        found,
        errors=errors,
        transforms={label: Composed(one, grow) for label, one in found.transforms.items()},
        matches=replace(found.matches, target=grow(found.matches.target)),
        others={s: replace(m, target=grow(m.target)) for s, m in found.others.items()},
        trace=None,
    )
