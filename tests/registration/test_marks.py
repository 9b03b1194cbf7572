"""Marks that two hands cannot share, off the drawing: whose they are, and where they cannot be compared."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.registration.marks import compare_marks

SHAPE = (360, 460)
EVERYWHERE = np.ones(SHAPE, bool)


def drawing(rng):
    """Return flat fields with sharp outlines, and lines."""
    tones = ndimage.gaussian_filter(rng.normal(size=SHAPE), 22)
    fields = 0.2 + 0.12 * np.digitize(tones / tones.std(), (-0.8, 0, 0.8))
    lines = np.abs(ndimage.gaussian_filter(rng.normal(size=SHAPE), 16)) * 16 < 0.02
    return fields * np.where(lines, 0.5, 1)


def cracks(rng):
    """Return a net of thin lines, 0..1: where smooth noise passes through zero."""
    field = ndimage.gaussian_filter(rng.normal(size=SHAPE), 3)
    return (np.abs(field) < 0.06 * field.std()).astype(float)


def panel(pattern, hand, *, cracked=0.3, strokes=0.03):
    rng = np.random.default_rng(hand)
    grain = ndimage.gaussian_filter(rng.normal(size=SHAPE), 1.3)
    marks = strokes * grain / grain.std() - cracked * cracks(rng)
    return ndimage.gaussian_filter(drawing(np.random.default_rng(pattern)) * (1 + marks), 0.7)


def photograph(surface, seed, noise=0.003):
    rng = np.random.default_rng(seed)
    return (surface + rng.normal(0, noise, SHAPE)).astype(np.float32)


@pytest.mark.parametrize("inverted", [False, True])
def test_marks_of_one_panel_agree_whatever_their_sign(inverted):
    one = panel(1, 1)
    found = compare_marks(
        photograph(one, 1), photograph(1 - one if inverted else one, 2), EVERYWHERE
    )
    assert found.correlation > 0.6


@pytest.mark.parametrize("pattern", [1, 2, 3])
def test_marks_of_two_panels_by_one_pattern_lie_at_other_places(pattern):
    found = compare_marks(
        photograph(panel(pattern, 1), 1), photograph(panel(pattern, 2), 2), EVERYWHERE
    )
    assert found.at_most < 0.25


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_picture_without_marks_is_not_held_against_the_map(noise):
    bare = panel(1, 1, cracked=0, strokes=0)
    found = compare_marks(photograph(panel(1, 1), 1), photograph(bare, 2, noise), EVERYWHERE)
    assert found.at_most >= 0.25
