import itertools

import cv2
import numpy as np
import pytest

from levkas.registration.bands import BandImage
from levkas.registration.chromatic import ChromaticShifts, interpolate_chromatic
from levkas.registration.measured_bands import LEAST_MEASURED, measured_bands

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


def test_a_band_beside_one_that_shows_nothing_is_measured():
    bands = scan()
    picks = measured_bands(bands)
    blind = bands[picks[5]]
    bands[picks[5]] = BandImage(
        blind.label, blind.wavelength, blind.values, np.zeros_like(blind.valid)
    )
    between = set(range(picks[4], picks[6] + 1))
    assert set(measured_bands(bands)) == {*picks, *between}


def test_amounts_of_all_bands_are_those_of_the_likeliest_process_over_wavelength():
    rng = np.random.default_rng(2)
    nm = np.linspace(400, 1000, 60)
    measured = nm[::5]
    y = np.sin(measured / 90) * 0.3 + rng.normal(0, 0.02, len(measured))
    variances = np.full((len(measured), 1), 4e-4)
    shifts = ChromaticShifts("shift", np.zeros(2), 1.0, y[:, None], variances)
    found = interpolate_chromatic(shifts, measured, nm)

    # The same, band by band and scale by scale, with inverse and determinant as they stand in the book.
    places = np.concatenate([measured, nm])
    # What is not seen counts as 0 in the mean square of the amounts.
    noise, size = np.diag(variances[:, 0] + 1e-10), (y**2).sum() / len(places)
    likeliest = (-np.inf, None, None)
    for length, smooth, own in itertools.product(
        (80.0, 200.0, 500.0), (0.0, 1.0, 10.0), (0.0, 0.01, 0.1, 1.0)
    ):
        bend = np.exp(-0.5 * ((places[:, None] - places) / length) ** 2)
        prior = 100 * size + size * (smooth * bend + own * np.eye(len(places)))
        observed, across = prior[: len(y), : len(y)] + noise, prior[len(y) :, : len(y)]
        likelihood = -0.5 * (y @ np.linalg.inv(observed) @ y + np.linalg.slogdet(observed)[1])
        if likelihood > likeliest[0] + 1e-6:
            mean = across @ np.linalg.inv(observed) @ y
            left = prior[len(y) :, len(y) :] - across @ np.linalg.inv(observed) @ across.T
            likeliest = likelihood, mean, np.diag(left)
    assert found.amounts[:, 0] == pytest.approx(likeliest[1], abs=1e-6)
    assert found.variances[:, 0] == pytest.approx(likeliest[2], abs=1e-6)
