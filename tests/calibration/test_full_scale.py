"""The code at which a sensor is full, by frames alone; ordinary bright frames are full nowhere."""

import numpy as np
import pytest

from levkas.calibration.codes import SceneShots, find_full_scale

H, W, BLACK, READ, FULL = 96, 160, 60.0, 2.5, 3600
RNG = np.random.default_rng(4)
Y, X = np.indices((H, W))
SHADE = 1 - 0.5 * ((Y / H - 0.5) ** 2 + (X / W - 0.5) ** 2)
PRNU, WELLS = (1 + 0.01 * RNG.standard_normal((H, W)) for _ in range(2))
PATCHES = np.kron(RNG.uniform(0.03, 0.9, (6, 10)), np.ones((16, 16)))
TEXTURE = 0.5 + 0.4 * np.sin(X * np.sin(Y / 9) + Y / 3)
GOLD = np.where((Y > 20) & (Y < 60) & (X > 40) & (X < 110), 1.35, PATCHES)


def shot(light, end="hard", *, gain=0.25, read=READ, black=BLACK, full=FULL, top=65535):
    """Codes of one shot; the end is the converter's, or a full well with read noise behind, the same or not everywhere."""
    counts = gain * RNG.poisson(light * PRNU / gain)
    wells = {"hard": np.inf, "soft": full - black, "wells": (full - black) * WELLS}[end]
    codes = np.rint(np.minimum(counts, wells) + RNG.normal(black, read, (H, W)))
    return codes.clip(0, full if end == "hard" else top).astype(np.uint16)


def frames(light, count=1, *, even=False, **more):
    return SceneShots([shot(light, **more) for _ in range(count)], even)


def dark(**more):
    return shot(0 * SHADE, end="soft", **more)


def found(*lit, darks=(), period=1):
    scale = find_full_scale(lit, darks, period=period)
    return scale and scale.counts


@pytest.mark.parametrize(
    ("white", "panel"),
    [(4200 * SHADE, TEXTURE), (3800 * SHADE, PATCHES), (3000 * SHADE, GOLD), (3600 + 0 * SHADE, PATCHES)],
)  # fmt: skip
def test_a_hard_end_is_found_from_one_shot_of_each(white, panel):
    for some in ([], [dark()]):
        assert found(frames(3000 * panel), frames(white, even=True), darks=some) == FULL


@pytest.mark.parametrize(("end", "share", "read"), [("soft", 0.99, 2.0), ("wells", 0.995, 5.0)])
def test_a_full_well_is_found_by_the_noise_that_its_shots_lack(end, share, read):
    for white, panel in ((5000 * SHADE, PATCHES), (3000 * SHADE, GOLD)):
        some = {"end": end, "read": read}
        counts = found(frames(3000 * panel, 2, **some), frames(white, 2, even=True, **some))
        lowest = FULL - BLACK if end == "soft" else (FULL - BLACK) * np.quantile(WELLS, 0.005)
        assert 0.95 * FULL < counts < FULL
        # Below it lies hardly any sensel that is full.
        full = shot(9000 * SHADE, **some)
        assert np.mean(full >= counts) > share, (counts, lowest)


def test_a_full_well_without_repeats_is_found_where_a_white_shows_the_noise_of_dimmer_light():
    some = {"end": "soft"}
    assert 3570 < found(frames(3000 * GOLD, **some), frames(3000 * SHADE, even=True, **some)) < FULL
    assert (
        3570 < found(frames(3000 * PATCHES, **some), frames(3900 * SHADE, even=True, **some)) < FULL
    )


@pytest.mark.parametrize(
    ("shots", "panel", "gain"),
    [(1, PATCHES, 0.25), (2, TEXTURE, 0.01), (1, GOLD, 1e-9), (2, GOLD, 0.25)],
)
def test_bright_frames_that_are_not_full_have_no_full_scale(panel, shots, gain):
    for white in (SHADE, 1 + 0 * SHADE):
        lit = frames(2600 * panel, shots, gain=gain, end="soft", full=1e9)
        even = frames(2600 * white, shots, gain=gain, end="soft", full=1e9, even=True)
        for some in ([], [dark()]):
            assert found(lit, even, darks=some) is None


def test_an_object_that_moved_between_its_shots_does_not_make_a_white_full():
    some = {"end": "soft", "full": 1e9}
    moved = SceneShots([shot(2600 * TEXTURE, **some), shot(2600 * np.roll(TEXTURE, 2, 1), **some)])
    white = frames(2600 * SHADE, 2, even=True, **some)
    assert found(moved, white) is None and found(moved, white, darks=[dark()]) is None


def test_what_was_drawn_without_noise_has_no_full_scale():
    wedge = np.repeat(np.linspace(100, 3000, 10), 16) * np.ones((H, 1))
    for plane in (wedge, 3000 * PATCHES, np.full((H, W), 2660.0), 3000 * SHADE, np.zeros((H, W))):
        codes = np.rint(plane).astype(np.uint16)
        for darks in ([], [np.full((H, W), 60, np.uint16)], [np.zeros((H, W), np.uint16)]):
            white = SceneShots([np.full((H, W), 2660, np.uint16)], True)
            assert found(SceneShots([codes, codes]), white, darks=darks) is None


def test_a_constant_frame_is_full_where_darks_have_noise_or_it_is_the_highest_code_of_some_bits():
    constant = SceneShots([np.full((H, W), FULL, np.uint16)], True)
    assert found(frames(3000 * TEXTURE), constant, darks=[dark()]) == FULL
    assert found(frames(3000 * TEXTURE), constant) is None
    assert found(SceneShots([np.full((H, W), 4095, np.uint16)], True)) == 4095
    assert found(SceneShots([np.full((H, W), 3000, np.uint16)], True)) is None


def test_codes_on_a_compression_curve_pile_up_as_others_do():
    x = np.arange(683)
    curve = np.rint(x + 0.01565 * np.maximum(x - 215, 0) ** 2)

    def squeezed(codes):
        return curve[np.searchsorted((curve[1:] + curve[:-1]) / 2, codes)].astype(np.uint16)

    def some(light, full):
        return SceneShots([squeezed(shot(light, full=full))])

    assert found(some(3000 * PATCHES, 4095), some(3300 * SHADE, 4095)) is None
    top = found(some(3000 * PATCHES, 3600), some(5000 * SHADE, 3600), darks=[dark()])
    assert top == squeezed(np.array([3600]))[0]


def test_eight_bits_through_a_tone_curve_have_no_full_scale_of_their_own():
    def photograph(light):
        linear = shot(light, end="soft", full=1e9).clip(BLACK) - BLACK
        shoulder = 250 * (1 - np.exp(-3.5 * linear / 3000))
        return np.rint(shoulder).astype(np.uint8)

    lit = SceneShots([photograph(3000 * PATCHES) for _ in range(2)])
    assert found(lit, SceneShots([photograph(3000 * SHADE) for _ in range(2)], True)) is None


def test_codes_in_the_upper_bits_and_phases_of_a_mosaic_are_no_piles():
    colours = np.where(X % 2, 0.5, 1.0)
    panel, white = shot(3000 * PATCHES * colours), shot(3000 * SHADE * colours)
    assert found(SceneShots([16 * panel]), SceneShots([16 * white], True), period=2) is None
    full = shot(5000 * SHADE * colours)
    assert found(SceneShots([16 * panel]), SceneShots([16 * full], True), period=2) == 16 * FULL


def test_reals_have_no_full_scale():
    assert found(SceneShots([np.minimum(SHADE, 0.9)])) is None


@pytest.mark.parametrize(("snr", "shade"), [(20.0, 0.1), (31.6, 0.0), (100.0, 0.4)])
def test_whites_of_much_noise_are_full_nowhere(snr, shade):
    """Of three bands: pixels that noise alone brings to the top in two of them differ little there, because they were picked so."""
    rng, side = np.random.default_rng(1), 256
    light = snr**2 * (
        1 - shade * np.sum(np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j] ** 2, 0) / 2
    )
    panel = np.kron(np.geomspace(0.01, 0.9, 64).reshape(8, 8), np.ones((side // 8, side // 8)))

    def codes(electrons):
        noisy = rng.poisson(electrons) + rng.normal(100, 6, electrons.shape)
        return np.rint(noisy).astype(np.uint16)

    whites = [SceneShots([codes(light)], even=True) for _ in range(3)]
    objects = [SceneShots([codes(light * panel)]) for _ in range(3)]
    assert found(*whites, *objects, darks=[codes(0 * light) for _ in range(2)]) is None
