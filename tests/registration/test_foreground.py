"""Where the object lies: bodies on an even ground, what lies between them, declared outlines."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.foreground import ObjectArea, segment_foreground


def texture(shape, seed=1):
    rough = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return 0.5 + 0.15 * rough / rough.std()


def on_a_ground(size, boxes, seed=1):
    """Return a picture, even but for noise, with texture in boxes (top, bottom, left, right)."""
    picture = np.full(size, 0.5) + np.random.default_rng(seed).normal(0, 0.002, size)
    for top, bottom, left, right in boxes:
        picture[top:bottom, left:right] = texture(size, seed)[top:bottom, left:right]
    return picture.astype(np.float32)


FIELDS = [(top, top + 34, left, left + 34) for top in (20, 80, 140) for left in (20, 80, 140, 200)]


def test_all_fields_of_a_palette_and_the_spaces_between_them_are_the_object():
    found = segment_foreground(on_a_ground((200, 260), FIELDS))
    assert found[20:174, 20:234].mean() > 0.99
    assert not found[:14].any() and not found[:, :14].any() and not found[:, 242:].any()


@pytest.mark.parametrize("level", [0.3, 0.5, 0.7])
def test_a_painting_with_a_sky_like_the_ground_is_whole(level):
    """Its upper part is as even as the ground and of one tone with it, but for a cloud and a border of paint."""
    picture = np.full((220, 200), level, np.float32)
    painting = texture((160, 140))
    painting[4:70, 4:136] = level
    painting[20:40, 30:80] = texture((20, 50), 3)
    picture[30:190, 30:170] = painting
    found = segment_foreground(picture + np.random.default_rng(2).normal(0, 0.002, picture.shape))
    assert found[30:190, 30:170].mean() > 0.99
    assert found.mean() < 1.1 * 160 * 140 / picture.size


def test_a_declared_outline_goes_before_the_ground_and_ends_what_is_compared():
    picture = on_a_ground((200, 260), FIELDS)
    area = ObjectArea.of(picture, outline=[(60, 50), (200, 50), (200, 150), (60, 150)])
    assert not area.automatic and area.body.sum() == 141 * 101
    assert area.compared.sum() == 133 * 93  # 4 px inside
    assert area.to_dict()["outline"] == [[60, 50], [200, 50], [200, 150], [60, 150]]


@pytest.fixture(scope="module")
def palette():
    """Fields on an even ground, and the same moved by 2.3 px and 1.4 px."""
    big = on_a_ground((240, 300), [tuple(side + 20 for side in box) for box in FIELDS])
    moved = ndimage.shift(big, (1.4, 2.3), order=3, mode="nearest")
    noise = np.random.default_rng(5).normal(0, 0.002, moved.shape)
    return BandImage.of("G", big, 550), BandImage.of("G", (moved + noise).astype(np.float32), 550)


def test_shares_are_of_the_layer_and_their_parts_are_the_whole(palette):
    reference, target = palette
    found = register([reference], [target])
    verdict, mask = found.verdict, found.model["mask"]
    assert verdict.decision == "accept"
    assert verdict.outside == pytest.approx(1 - mask["share"], abs=1e-4)
    assert 0.35 < verdict.outside < 0.55 and verdict.outside <= verdict.unchecked
    stated = f"over the {round(100 * (1 - verdict.unchecked))} % of the layer that was checked"
    assert stated in verdict.reasons[0]
    assert verdict.reasons[-1].endswith("lies outside the object's outline and was not checked.")
    assert verdict.next_step == ""
    # A layer of the object alone has nothing outside.
    x, y = 45, 45
    layer = [(x, y), (x + 200, y), (x + 200, y + 140), (x, y + 140)]
    cut = register([reference], [target], layer=layer).verdict
    assert cut.outside < 0.01 and cut.unchecked < 0.1


@pytest.mark.parametrize("method", ["levkas", "mirhashemi2019"])
def test_nothing_outside_a_declared_outline_is_judged(palette, method):
    reference, target = palette
    outline = [(35, 35), (170, 35), (170, 200), (35, 200)]
    found = register([reference], [target], method=method, outline=outline)
    share = 136 * 166 / (240 * 300)
    assert found.model["mask"]["share"] == pytest.approx(share, abs=0.01)
    assert found.verdict.outside == pytest.approx(1 - share, abs=0.01)
    assert found.verdict.decision != "refuse"
    miss = found.transforms["G"](np.array([[100.0, 100]])) - [102.3, 101.4]
    assert np.abs(miss).max() < 0.1


@pytest.mark.parametrize(
    ("outline", "text"),
    [
        ([(0, 0), (500, 0), (500, 90)], "outside the reference"),
        ([(0, 0), (50, 0)], "not valid"),
        ([(0, 0), (50, 0), (np.nan, 9)], "not valid"),
    ],
)
def test_an_outline_that_is_none_or_leaves_the_frame_is_refused(palette, outline, text):
    with pytest.raises(RegistrationRefused) as refused:
        register([palette[0]], [palette[1]], outline=outline)
    assert text in str(refused.value) and refused.value.problems[0].field in (
        "outline",
        "registration.outline",
    )
