"""What the reference would look like in any band: its registered bands, condensed.

A painting has few pigments in any one place, so that a handful of images span what every band
shows there. A target band is predicted as their linear combination, with gains of its own in each
window: near infrared is predicted from the visible as well as the overlap of pigments allows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from levkas.registration.refinement import Predictor, Windows, highpass, reduce, warp
from levkas.transforms import Transform

COMPONENTS = 5
BLURRED = 2


def registered(
    images: Mapping[str, np.ndarray],
    transforms: Mapping[str, Transform],
    shape: tuple[int, int],
    *,
    step: int = 1,
) -> np.ndarray:
    """Return the bands in the reference frame, (bands, h, w), in the order of `transforms`."""
    size = (shape[0] // step, shape[1] // step)
    return np.stack(
        [sampled(images[label], transform, size, step) for label, transform in transforms.items()]
    )


def sampled(
    image: np.ndarray, transform: Transform, size: tuple[int, int], step: int, *, block: int = 1
) -> np.ndarray:
    """Warp one band on to a grid of `step` reference px, averaged over blocks of the target."""
    from levkas.registration.initial import turned

    factor = max(1, block * step)
    source = reduce(np.ascontiguousarray(image, np.float32), factor) if factor > 1 else image
    return warp(source, turned(transform, factor), size, step=step)


def compared(predictor: Predictor, image: np.ndarray) -> Windows:
    """Return the shifts of `image`, sampled in the predictor's frame, once its slow part is out."""
    return predictor.compare(highpass(image))


def condense(stack: np.ndarray, count: int = COMPONENTS, *, ready: bool = True) -> np.ndarray:
    """Return the principal images of `stack`; if `ready`, high-passed, with blurred copies.

    Parameters
    ----------
    stack : ndarray, (bands, h, w)
        NaN where invalid in a band.
    count : int
        Most principal images; those of less than 1e-6 of the variance are left out.
    Returns
    -------
    images : ndarray, (k, h, w), float32
        In their natural size, so that a ridge weighs on what varies little.
    """
    whole = np.isfinite(stack).all(0)
    if not whole.any():
        return stack[:1].astype(np.float32)
    mean = np.nanmean(stack, axis=(1, 2))
    # Differences over a few pixels: what remains of the bands once their slow parts are out.
    rough = stack[:, ::2, 4::2] - stack[:, ::2, :-4:2]
    flat = rough[:, np.isfinite(rough).all(0)].astype(np.float64)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(-values)[:count]
    order = order[values[order] > 1e-6 * max(values[order[0]], 1e-300)]
    if not len(order):
        order = np.argsort(-values)[:1]
    vectors = vectors[:, order] * np.sign(vectors[np.abs(vectors[:, order]).argmax(0), order])
    images = np.tensordot(vectors.T, stack - mean[:, None, None], 1).astype(np.float32)
    return with_blurred(np.stack([highpass(image) for image in images])) if ready else images


def with_blurred(images: np.ndarray) -> np.ndarray:
    """Append blurred copies of the first images: a combination of both is as sharp as the target."""
    return np.concatenate([images, soften(soften(images[:BLURRED]))])


def soften(images: np.ndarray) -> np.ndarray:
    """Blur (k, h, w) images by (1 4 6 4 1)/16 on both axes: one pixel of sigma; NaN spreads."""
    for axis in (1, 2):
        padded = np.pad(images, [(2, 2) if a == axis else (0, 0) for a in range(3)], mode="edge")
        n = images.shape[axis]
        parts = [np.take(padded, range(k, k + n), axis) for k in range(5)]
        images = (parts[0] + parts[4] + 4 * (parts[1] + parts[3]) + 6 * parts[2]) / 16
    return images.astype(np.float32)


def cell_px(shape: Sequence[int]) -> int:
    """Return the cell of the windows for a frame: 12 px for small frames, 16 for large ones."""
    return 12 if min(shape) < 600 else 16


class Scene:
    """The reference's bands in the reference frame, as predictors at any step.

    Parameters
    ----------
    stack : ndarray, (bands, h, w)
        Registered bands; NaN where invalid.
    """

    def __init__(self, stack: np.ndarray) -> None:
        self.images = condense(stack, ready=False)
        self._ready: dict[int, Predictor] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the reference frame."""
        return self.images.shape[1], self.images.shape[2]

    def predictor(self, step: int = 1) -> Predictor:
        """Return the predictor on a grid of `step` reference px."""
        if step not in self._ready:
            images = self.images
            if step > 1:
                images = np.stack([reduce(image, step) for image in images])
                images = _spline_seen(images)
            stack = with_blurred(np.stack([highpass(image) for image in images]))
            self._ready[step] = Predictor(stack, step=step, cell=cell_px(stack.shape[1:]))
        return self._ready[step]


def _spline_seen(images: np.ndarray) -> np.ndarray:
    for axis in (1, 2):
        padded = np.pad(images, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        n = images.shape[axis]
        parts = [np.take(padded, range(k, k + n), axis) for k in range(3)]
        images = (parts[0] + 4 * parts[1] + parts[2]) / 6
    return images.astype(np.float32)
