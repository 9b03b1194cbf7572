"""Orientation correlation: poses of pictures that share outlines only, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, register
from levkas.registration.orientation_correlation import match_by_directions
from levkas.registration.verdict import Evidence, objections_to

SIZE = (260, 200)


def scene(seed):
    """Discs and bars without texture, (h, w) float32, and the same outlines in other tones."""
    import cv2

    rng = np.random.default_rng(seed)
    visible, heat = (np.full((300, 400), 0.5, np.float32) for _ in range(2))
    for _ in range(40):
        at = tuple(int(v) for v in rng.integers((0, 0), (400, 300)))
        to = tuple(int(a + d) for a, d in zip(at, rng.integers(-90, 90, 2), strict=True))
        tones, wide = rng.uniform(0.1, 0.9, 2), int(rng.integers(6, 26))
        for picture, tone in zip((visible, heat), tones, strict=True):
            if wide % 2:
                cv2.circle(picture, at, wide, float(tone), -1)
            else:
                cv2.line(picture, at, to, float(tone), wide // 2)
    return visible, cv2.GaussianBlur(heat, (0, 0), 1.5)


def observed(picture, to_picture, seed, size=SIZE):
    """Return a picture through a map of px to its px, with noise."""
    import cv2

    matrix = to_picture.matrix.astype(np.float64)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    noise = np.random.default_rng(seed).normal(0, 0.02, values.shape)
    return (values + noise).astype(np.float32)


def turned(angle, scale, size=SIZE):
    """Return the map of px to the scene's px of a camera at its middle."""
    c, s = scale * np.cos(np.deg2rad(angle)), scale * np.sin(np.deg2rad(angle))
    linear = np.array([[c, -s], [s, c]])
    return Affine(
        np.column_stack([linear, np.array([200.0, 150.0]) - linear @ (np.array(size) / 2)])
    )


def between(home, there):
    """Return the map of one camera's px to the other's."""
    ours, theirs = (np.vstack([one.matrix, [0, 0, 1]]) for one in (home, there))
    return Affine(np.linalg.solve(theirs, ours)[:2])


def worst(transform, truth):
    x, y = np.meshgrid(np.linspace(20, 240, 6), np.linspace(20, 180, 5))
    points = np.stack([x.ravel(), y.ravel()], 1)
    return float(np.linalg.norm(transform(points) - truth(points), axis=1).max())


@pytest.mark.parametrize(("angle", "scale"), [(7.0, 1.15), (-94.0, 0.9), (172.0, 1.1)])
def test_the_pose_of_outlines_in_other_tones_is_found(angle, scale):
    visible, heat = scene(3)
    home, there = turned(0, 1), turned(angle, scale)
    found = match_by_directions([observed(visible, home, 1)], [observed(heat, there, 2)])
    assert found is not None and not found.mirrored
    truth = between(home, there)
    assert worst(found.transform, truth) < 2.5
    assert found.kept.sum() >= 20


@pytest.mark.parametrize(
    "seed", [4, 5, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in range(6, 10))]
)
def test_other_outlines_have_no_pose(seed):
    visible, heat = scene(3)[0], scene(seed)[1]
    home = turned(0, 1)
    assert match_by_directions([observed(visible, home, 1)], [observed(heat, home, 2)]) is None


@pytest.mark.slow
def test_pictures_that_share_outlines_only_are_registered_and_doubted():
    visible, heat = scene(3)
    home, there = turned(0, 1), turned(4, 1.1)
    ours, theirs = (
        [BandImage.of("grey", observed(picture, at, k))]
        for k, (picture, at) in enumerate([(visible, home), (heat, there)])
    )
    found = register(ours, theirs, reference_band="grey")
    truth = between(home, there)
    assert worst(found.transforms["grey"], truth) < 1.5
    assert found.verdict.decision != "refuse"
    sigma = found.sigma["grey"](np.array([[130.0, 100.0], [5.0, 5.0]]))
    assert np.isfinite(sigma).all() and (sigma > 0).all()


UNSURE = Evidence(
    basis="windows", kept=20, terms=6, begun="outlines", share_above_chance=0.1, held_out_px=np.inf, overlap=1.0, folded=0.0,
    mirrored=False, windows=8, found=0, agreeing=0, contradicting=0, window_median=np.inf, tolerance=1.0, second_peak_ratio=0.2, coverage=0.0,
    off_share=0.0, off=[], unsupported=[[0, 0, 5, 5]], checked=0.0, unchecked=[[0, 0, 9, 9, 1.0]], box=(0, 0, 9, 9),
)  # fmt: skip


def test_want_of_evidence_is_a_doubt_where_outlines_agree():
    for agreeing, elsewhere, refused in ((28, 0.2, False), (12, 0.2, True), (28, 1.2, True)):
        outlines = {"blocks": 30, "agreeing": agreeing, "px": 2.0}
        found = objections_to(replace(UNSURE, outlines=outlines, second_peak_ratio=elsewhere))
        assert ("refuse" in [one.decision for one in found]) == refused
