import cv2
import numpy as np
import pytest

from levkas.registration.bands import BandImage
from levkas.registration.chromatic import LEAST_MEASURED, measured_bands

COUNT = 2 * LEAST_MEASURED
TURN = np.radians(0.2)


def scan(moved=None):
    """Fifty bands of one scene whose contrast changes slowly; some seen through a map of their own."""
    rng = np.random.default_rng(3)
    scene = [cv2.GaussianBlur(rng.random((300, 400), np.float32), (0, 0), 2) for _ in range(2)]
    bands = []
    for k in range(COUNT):
        share = np.float32(k / COUNT)
        picture = (1 - share) * scene[0] + share * scene[1]
        if moved is not None and k in moved:
            picture = cv2.warpAffine(picture, moved[k], (400, 300), flags=cv2.INTER_CUBIC)
        noise = rng.normal(0, 0.002, picture.shape).astype(np.float32)
        bands.append(BandImage.of(str(k), picture + noise, 400.0 + 10 * k))
    return bands


def test_every_second_of_fifty_bands_is_measured_and_all_of_fewer():
    bands = scan()
    picks = measured_bands(bands)
    assert len(picks) == LEAST_MEASURED
    assert {0, COUNT - 1} <= set(picks)
    assert len(measured_bands(bands, also=21)) == LEAST_MEASURED + (21 not in picks)
    assert measured_bands(bands[1:]) == list(range(COUNT - 1))
    unknown = [BandImage.of(band.label, band.values) for band in bands]
    assert measured_bands(unknown) == list(range(COUNT))


@pytest.mark.slow
@pytest.mark.parametrize(
    "moved",
    [
        [[1, 0, 0.3], [0, 1, 0.0]],
        [[np.cos(TURN), -np.sin(TURN), 150 * TURN], [np.sin(TURN), np.cos(TURN), -200 * TURN]],
    ],
    ids=["shifted", "turned about the middle"],
)
def test_a_band_that_was_moved_is_measured_too(moved):
    bands = scan()
    alone = next(k for k in range(20, COUNT) if k not in measured_bands(bands))
    found = measured_bands(scan({alone: np.array(moved)}))
    assert alone in found
    assert len(found) == LEAST_MEASURED + 1
