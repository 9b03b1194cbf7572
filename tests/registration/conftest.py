"""A painted surface, photographed through known maps."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

SIZE = (300, 230)
MARGIN = 60


@pytest.fixture(scope="session")
def studio():
    """Return where pictures are taken: `size` of the reference, `paint(seed)`, `photograph(…)`."""
    return Studio()


class Studio:
    size = SIZE

    def paint(self, seed):
        return surface(seed)

    def photograph(self, painting, mapping, size=SIZE, *, seed=0, noise=0.004):
        return photograph(painting, mapping, size, seed=seed, noise=noise)


def surface(seed):
    """Return patches, brush strokes and cracks, (h, w) float64, `MARGIN` px wider on each side."""
    rng = np.random.default_rng(seed)
    w, h = SIZE[0] + 2 * MARGIN, SIZE[1] + 2 * MARGIN
    rows, columns = np.mgrid[0:h, 0:w]
    places = np.stack([rows.ravel(), columns.ravel()], 1)
    _, patch = cKDTree(rng.uniform(0, 1, (70, 2)) * (h, w)).query(places)
    distance, _ = cKDTree(rng.uniform(0, 1, (250, 2)) * (h, w)).query(places, k=2)
    cracks = np.exp(-np.square((distance[:, 1] - distance[:, 0]).reshape(h, w) / 1.5))
    strokes = sum(
        weight * blurred / blurred.std()
        for weight, sigma in ((0.6, 1.5), (0.8, 3.5))
        if (blurred := ndimage.gaussian_filter(rng.normal(0, 1, (h, w)), (sigma, 2 * sigma))).any()
    )
    colours = rng.uniform(0.1, 0.7, 70)[patch].reshape(h, w)
    return ndimage.gaussian_filter(colours * (1 + 0.1 * strokes) * (1 - 0.35 * cracks), 0.7)


def photograph(painting, mapping, size, *, seed, noise):
    """Return what a camera sees whose px lie at `mapping` (camera px → reference px)."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places = mapping(np.stack([x.ravel(), y.ravel()], 1)) + MARGIN
    values = ndimage.map_coordinates(painting, places.T[::-1], order=3, mode="nearest")
    values += np.random.default_rng(seed).normal(0, noise, len(values))
    return values.reshape(size[1], size[0]).astype(np.float32)
