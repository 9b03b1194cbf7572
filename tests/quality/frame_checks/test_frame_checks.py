"""Frames of a camera with shot noise before a panel of patches: each fault is planted in light, at two sizes, and named."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from levkas.quality.frame_checks import (
    FrameMeasures,
    FrameOfSet,
    FramePictures,
    judge,
    measure_frame,
    worst,
)
from levkas.quality.frame_checks.judging import FrameJudge, SetRules
from levkas.readers.facts import Facts

HEIGHT, WIDTH = 360, 480
BLACK, FULL, GAIN, READ = 64.0, 4095, 0.4, 3.0
FACTS = Facts(
    Path("a.tif"),
    "tiff",
    (HEIGHT, WIDTH),
    "uint16",
    bits=12,
    iso=100.0,
    f_number=8.0,
    white_balance="manual",
)


def panel() -> np.ndarray:
    """Reflectance: patches of paint with a border of dark wall round them, a lens of 0.8 px blur."""
    rng = np.random.default_rng(5)
    paint = np.kron(rng.uniform(0.1, 0.85, (30, 40)), np.ones((9, 9)))
    scene = np.full((HEIGHT, WIDTH), 0.03)
    scene[45:315, 60:420] = paint
    return gaussian_filter(scene, 0.8)


PANEL = panel()
SHADING = 1 - 0.12 * np.linspace(-1, 1, WIDTH) ** 2 * np.ones((HEIGHT, 1))
RESPONSE = 1 + 0.01 * np.random.default_rng(80).normal(size=(HEIGHT, WIDTH))  # of single sensels


def expose(
    light: np.ndarray | float,
    seed: int,
    *,
    lamp: float = 1.0,
    black: float = BLACK,
    noise: float = 1.0,
) -> np.ndarray:
    """Return codes of a scene of some reflectance; the white has 3,300 counts above black."""
    rng = np.random.default_rng(seed)
    signal = 3300 * lamp * np.broadcast_to(light, (HEIGHT, WIDTH)) * SHADING * RESPONSE
    spread = noise * np.sqrt(GAIN * np.maximum(signal, 0) + READ**2)
    return np.round(rng.normal(signal + black, spread)).clip(0, FULL).astype(np.uint16)


def frame(name: str, role: str, codes: np.ndarray, **more: object) -> FrameOfSet:
    measures = measure_frame(codes, full=FULL, white=role == "white")
    target = {"object": "icon"}.get(role, role)
    given = {"full": FULL, "exposure_s": 0.1, "at": float(name[:2]), "facts": FACTS, **more}
    return FrameOfSet(name=name, role=role, target=target, measures=measures, **given)  # type: ignore[arg-type]


@cache
def good_frames() -> dict[str, FrameOfSet]:
    """Return a good session: two darks, two whites, three shots of the panel, a white after it."""
    frames = [
        *(frame(f"0{k} dark", "dark", expose(0.0, k)) for k in (1, 2)),
        *(frame(f"0{k} white", "white", expose(0.98, k)) for k in (3, 4)),
        *(frame(f"0{k} shot", "object", expose(PANEL, k)) for k in (5, 6, 7)),
        frame("08 white", "white", expose(0.98, 8, lamp=0.995)),
    ]
    return {one.name: one for one in frames}


@cache
def warm_judge() -> FrameJudge:
    """Return a judge that knows the good frames."""
    judge_ = FrameJudge()
    judge_.judge(good_frames().values())
    return judge_


def blob(size: int) -> np.ndarray:
    light = PANEL.copy()
    light[100 : 100 + size, 150 : 150 + size] = 1.2
    return light


def speck(radius: float, depth: float) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return 0.98 * (1 - depth * np.exp(-((x - 300) ** 2 + (y - 80) ** 2) / (2 * radius**2)))


def half_covered(share: float) -> np.ndarray:
    return np.where(np.arange(WIDTH) < share * WIDTH, PANEL, 0.98)


def lit_dark(level: float) -> np.ndarray:
    return level * np.linspace(0, 1, WIDTH) * np.ones((HEIGHT, 1))


CASES = {
    "white at full scale, a little": lambda: ("exposure", "08 white", expose(0.98, 8, lamp=1.21), {}),
    "white at full scale": lambda: ("exposure", "08 white", expose(0.98, 8, lamp=1.6), {}),
    "white without light for the scale": lambda: ("exposure", "08 white", expose(0.98, 8, lamp=0.05), {}),
    "object at full scale, a little": lambda: ("exposure", "07 shot", expose(blob(60) * 1.05, 7), {}),
    "object at full scale": lambda: ("exposure", "07 shot", expose(PANEL, 7, lamp=1.8), {}),
    "dark with a little light": lambda: ("dark", "02 dark", expose(lit_dark(0.02), 2), {}),
    "dark with the lamp on": lambda: ("dark", "02 dark", expose(lit_dark(0.4), 2), {}),
    "black level, a little": lambda: ("black", "02 dark", expose(0.0, 2, black=BLACK + 14), {}),
    "black level": lambda: ("black", "02 dark", expose(0.0, 2, black=BLACK + 30), {}),
    "dark of another time": lambda: ("dark", "07 shot", expose(PANEL, 7), {"exposure_s": 0.2}),
    "dark of a far time": lambda: ("dark", "07 shot", expose(PANEL, 7), {"exposure_s": 2.0}),
    "white with some of the painting": lambda: ("white", "04 white", expose(half_covered(0.2), 4), {}),
    "white that is the painting": lambda: ("white", "04 white", expose(PANEL, 4), {}),
    "lamp sank by 4 %": lambda: ("drift", "08 white", expose(0.98, 8, lamp=0.96), {}),
    "lamp sank by 12 %": lambda: ("drift", "08 white", expose(0.98, 8, lamp=0.88), {}),
    "lamp sank in the stack, a little": lambda: ("drift", "07 shot", expose(PANEL, 7, lamp=0.98), {}),
    "lamp sank in the stack": lambda: ("drift", "07 shot", expose(PANEL, 7, lamp=0.9), {}),
    "noise, a little": lambda: ("noise", "07 shot", expose(PANEL, 7, noise=1.5), {}),
    "noise of a white": lambda: ("noise", "08 white", expose(0.98, 8, noise=3), {}),
    "noise of a dark": lambda: ("noise", "02 dark", expose(0.0, 2, noise=2), {}),
    "focus, a little": lambda: ("focus", "07 shot", expose(gaussian_filter(PANEL, 1.6), 7), {}),
    "focus": lambda: ("focus", "07 shot", expose(gaussian_filter(PANEL, 3), 7), {}),
    "moved by 0.9 px": lambda: ("moved", "07 shot", expose(shift(PANEL, (0.5, 0.75), mode="nearest"), 7), {}),
    "moved by 1.5 px": lambda: ("moved", "07 shot", expose(shift(PANEL, (0.9, 1.2), mode="nearest"), 7), {}),
    "moved by 30 px": lambda: ("moved", "07 shot", expose(shift(PANEL, (5, 30), mode="nearest"), 7), {}),
    "another panel": lambda: ("moved", "07 shot", expose(PANEL[::-1, ::-1], 7), {}),
    "another light": lambda: ("drift", "07 shot", expose(PANEL * np.linspace(0.5, 1.4, WIDTH), 7), {}),
    "another exposure": lambda: ("drift", "07 shot", expose(PANEL, 7, lamp=0.79), {}),
    "glare, a little": lambda: ("glare", "07 shot", expose(blob(50), 7, lamp=0.95), {}),
    "glare": lambda: ("glare", "07 shot", expose(blob(160), 7, lamp=0.95), {}),
    "dust, one speck": lambda: ("dust", "08 white", expose(speck(3, 0.15), 8), {}),
    "dust, a large speck": lambda: ("dust", "08 white", expose(speck(6, 0.5), 8), {}),
    "another ISO": lambda: ("settings", "07 shot", expose(PANEL, 7), {"facts": replace(FACTS, iso=200.0)}),
    "another aperture": lambda: (
        *("settings", "07 shot", expose(PANEL, 7)),
        {"facts": replace(FACTS, f_number=5.6)},
    ),
    "another white balance": lambda: (
        *("settings", "07 shot", expose(PANEL, 7)),
        {"facts": replace(FACTS, white_balance="auto")},
    ),
    "object at the border": lambda: ("framing", "07 shot", expose(np.roll(PANEL, -60, axis=1), 7), {}),
    "object cut": lambda: ("framing", "07 shot", expose(np.pad(PANEL, ((0, 0), (0, 150)), "edge")[:, 150:], 7), {}),
    "another size": lambda: ("settings", "07 shot", expose(PANEL, 7)[:-20, :-20], {}),
}  # fmt: skip


def test_a_good_session_has_no_finding():
    assert {name: found for name, found in judge(good_frames().values()).items() if found} == {}


@pytest.mark.parametrize("case", CASES)
def test_a_planted_fault_is_named_at_its_frame(case):
    check, name, codes, more = CASES[case]()
    role = good_frames()[name].role
    frames = {**good_frames(), name: frame(name, role, codes, **more)}

    found = copy(warm_judge()).judge(frames.values())  # what the good ones get is known already

    assert check in [one.check for one in found[name]]
    assert all(one.text and one.advice for one in found[name])
    others = [n for n, some in found.items() if some and n != name and n > name[:2]]
    assert len(others) <= 1  # a shot or white after it that is compared with the faulty one


def test_small_and_large_differ_in_severity():
    def severity(case: str) -> str:
        _, name, codes, more = CASES[case]()
        frames = {**good_frames(), name: frame(name, good_frames()[name].role, codes, **more)}
        return worst(copy(warm_judge()).judge(frames.values())[name])

    pairs = (("moved by 0.9 px", "moved by 1.5 px"), ("lamp sank by 4 %", "lamp sank by 12 %"))
    for small, large in (*pairs, ("focus, a little", "focus")):
        assert (severity(small), severity(large)) == ("look", "stop"), small


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("case", ["another panel", "another light", "another exposure"])
def test_what_a_build_refuses_is_no_shot_while_the_session_lasts(case, plain):
    check, name, codes, _ = CASES[case]()
    frames = {**good_frames(), name: frame(name, "object", codes)}
    found = judge(frames.values(), SetRules(plain=plain))
    assert ("stop", check) in [(one.severity, one.check) for one in found[name]]


def test_the_numbers_in_the_reasons_are_those_planted():
    _, name, codes, _ = CASES["lamp sank by 4 %"]()
    found = copy(warm_judge()).judge({**good_frames(), name: frame(name, "white", codes)}.values())[
        name
    ]
    assert "4" in found[0].text.split("%")[0] and "less" in found[0].text
    _, name, codes, _ = CASES["moved by 1.5 px"]()
    found = copy(warm_judge()).judge(
        {**good_frames(), name: frame(name, "object", codes)}.values()
    )[name]
    assert abs(float(found[0].text.split("moved by ")[1].split(" px")[0]) - 1.5) <= 0.2


@pytest.mark.parametrize(
    ("blurs", "way"), [((0, 1.2, 1.8), "getting worse"), ((0, 3, 1.6), "getting better")]
)
def test_the_way_that_the_focus_runs_is_told(blurs, way):
    shots = {
        f"{k} shot": frame(f"0{k} shot", "object", expose(gaussian_filter(PANEL, blur), k))
        for k, blur in enumerate(blurs, 5)
    }
    found = judge([*[*good_frames().values()][:4], *shots.values()])["07 shot"]
    assert [one.text.endswith(way) for one in found if one.check == "focus"] == [True]


def test_findings_hang_on_the_set_and_not_on_the_order_of_coming():
    _, name, codes, _ = CASES["lamp sank by 4 %"]()
    frames = list({**good_frames(), name: frame(name, "white", codes)}.values())
    whole = judge(frames)
    growing = FrameJudge()
    for count in (1, 4, 6, len(frames)):
        found = growing.judge(reversed(frames[-count:]))
    assert found == whole
    assert growing.judge(frames[:-1]) == judge(frames[:-1])  # one was deleted


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_frames_judged_as_they_come_and_go_are_judged_as_all_at_once(seed):
    """Objects and bands that a frame does not touch keep their findings: they must be those of a judge who sees all anew."""
    rng, whole = np.random.default_rng(seed), dict(good_frames())
    measures = [one.measures for one in whole.values() if one.role == "object"]
    measures.append(measure_frame(expose(PANEL, 30, noise=2.0), full=FULL))
    for k in range(24):
        role = "dark" if k == 23 else "white" if k == 22 else "object"
        made = FrameOfSet(
            f"{k + 10} more", role, f"panel {k % 3}", FACTS, measures[k % 4], band=f"{k % 4}",
            at=float(k), exposure_s=(0.1, 0.1, 0.2)[k % 3], full=FULL,
        )  # fmt: skip
        whole[made.name] = made
    follower, there = FrameJudge(), {}
    for k, name in enumerate(rng.permutation([*whole, *whole])):
        if name in there and rng.random() < 0.5:
            del there[name]
        else:
            there[name] = whole[name]
        found = follower.judge(there.values())
        assert k % 9 or found == judge(there.values())


def test_what_a_campaign_allows_is_no_finding():
    _, name, codes, more = CASES["another ISO"]()
    frames = {**good_frames(), name: frame(name, "object", codes, **more)}.values()
    assert judge(frames, SetRules(overrule=("iso",)))[name] == []
    _, name, codes, _ = CASES["object at full scale"]()
    frames = {**good_frames(), name: frame(name, "object", codes, exposure_s=0.1)}.values()
    brackets = judge(frames, SetRules(brackets=True))[name]
    assert "exposure" not in [one.check for one in brackets]


def test_shots_are_compared_with_the_first_of_their_stack_and_not_with_the_one_before():
    dim = frame("06 shot", "object", expose(PANEL, 6, lamp=0.98))
    found = judge({**good_frames(), "06 shot": dim}.values())
    drifting = {name for name, some in found.items() if any(f.check == "drift" for f in some)}
    assert drifting == {"06 shot"}  # the third has the light of the first again


@pytest.mark.parametrize(
    ("name", "role", "codes"),
    [
        ("01 dark", "dark", expose(lit_dark(0.4), 1)),
        ("03 white", "white", expose(0.98, 3, lamp=1.6)),
        ("03 white", "white", expose(PANEL, 3)),
        ("05 shot", "object", expose(PANEL, 5, lamp=1.8)),
    ],
    ids=["lit dark", "clipped white", "white that is the painting", "clipped shot"],
)
def test_a_frame_after_one_to_capture_again_is_not_compared_with_it(name, role, codes):
    found = judge({**good_frames(), name: frame(name, role, codes)}.values())
    assert worst(found[name]) == "stop"
    blamed = {n: [(f.check, f.text) for f in some] for n, some in found.items() if some}
    assert set(blamed) == {name}, blamed


def test_of_three_whites_the_noisy_one_is_named_and_not_the_two_others():
    noisy = frame("03 white", "white", expose(0.98, 3, noise=6))
    found = judge({**good_frames(), "03 white": noisy}.values())
    assert {n for n, some in found.items() for f in some if f.check == "noise"} == {"03 white"}


@pytest.mark.parametrize("tiles", [("", ""), ("r0c0", "r0c1")])
def test_tiles_are_scenes_of_their_own(tiles):
    """The second tile shows the panel 30 px further and softer: as a shot it has moved and is out of focus."""
    shown = PANEL, gaussian_filter(shift(PANEL, (0, 30), mode="nearest"), 2)
    frames = [
        frame(f"0{5 + k} shot", "object", expose(light, 5 + k), tile=tile)
        for k, (light, tile) in enumerate(zip(shown, tiles, strict=True))
    ]
    found = judge([*[*good_frames().values()][:4], *frames])["06 shot"]
    assert {one.check for one in found} == (set() if tiles[0] else {"moved", "focus"})


@pytest.mark.parametrize(("target", "white", "verdict"), [
    ("icon", False, "stop"), ("other", False, "look"), ("other", True, "stop"),
])  # fmt: skip
def test_a_setting_stops_a_frame_where_a_build_refuses_it(target, white, verdict):
    """Shots of one object, and an object and its white, must agree; two objects need not."""
    frames = [frame("05 shot", "object", expose(PANEL, 5))]
    frames += [frame("04 white", "white", expose(0.98, 4))] * white
    frames += [
        replace(
            frame("06 shot", "object", expose(PANEL, 6), facts=replace(FACTS, iso=200.0)),
            target=target,
        )
    ]
    (one,) = (f for f in judge(frames)["06 shot"] if f.check == "settings")
    assert one.severity == verdict
    assert ("most others" in one.text) == white  # one of two is not most


def test_a_white_that_is_a_picture_stops_and_tells_of_no_glare():
    picture = 0.2 + 0.8 * np.kron([[1, 0, 1], [0, 1, 0]], np.ones((180, 160)))
    frames = [
        frame("03 white", "white", expose(picture, 3)),
        frame("05 shot", "object", expose(0.9, 5)),
    ]
    found = judge(frames)
    assert [(f.check, f.severity) for f in found["03 white"]] == [("white", "stop")]
    assert "glare" not in [f.check for f in found["05 shot"]]


def test_an_object_cut_at_a_side_is_named_with_the_side():
    whole = measure_frame(expose(PANEL, 1))
    cut = measure_frame(
        expose(np.roll(PANEL, 130, axis=1)[:, :] * 1.0, 1)
    )  # 70 px beyond the right
    frames = [
        frame("05 shot", "object", expose(PANEL, 1)),
        replace(frame("06 shot", "object", expose(PANEL, 2)), measures=cut, target="other"),
    ]
    right = np.full((HEIGHT, WIDTH), 0.03)
    right[:, 150:] = PANEL[:, 20:350]
    frames[1] = replace(frames[1], measures=measure_frame(expose(right, 3)))
    found = judge(frames)
    assert whole.picture.shape == cut.picture.shape
    assert found["05 shot"] == []
    assert any(one.check == "framing" and "right" in one.text for one in found["06 shot"])


def test_a_frame_that_came_twice_names_the_first():
    codes = expose(PANEL, 7)
    frames = {**good_frames(), "09 shot": frame("09 shot", "object", codes)}.values()
    found = judge([f for f in frames if f.name != "06 shot"])
    assert [one.check for one in found["09 shot"]] == ["twice"] and "07 shot" in found["09 shot"][
        0
    ].text


@pytest.mark.parametrize("times", [1, 16])  # codes of 12 bits, moved up to 16 or not
def test_measures_survive_being_kept(times):
    kept = measure_frame(np.uint16(times) * np.maximum(expose(PANEL, 5), 4095 * (PANEL > 0.8)))
    pictures = FramePictures.from_bytes(kept.pictures.to_bytes())
    again = FrameMeasures.from_bytes(kept.to_bytes(), pictures)
    assert again.key == kept.key
    assert np.array_equal(again.cells, kept.cells) and np.array_equal(
        pictures.patches, kept.pictures.patches
    )
    assert kept.picture.max() > 4000 * times
    assert np.allclose(again.picture, kept.picture, rtol=1e-3)


@pytest.mark.parametrize("pattern", ["RGGB", None])
def test_a_mosaic_is_judged_channel_by_channel(pattern):
    filters = np.tile([[0.5, 1.0], [1.0, 0.35]], (HEIGHT // 2, WIDTH // 2))
    good = measure_frame(expose(0.98 * filters, 1), full=FULL, pattern="RGGB")
    assert good.level.shape == (3,) and np.argmax(good.level) == 1
    bright = measure_frame(expose(0.98 * filters, 1, lamp=1.4), full=FULL, pattern=pattern)
    assert bright.full_share.max() > (0.9 if pattern else 0.4)


@pytest.mark.parametrize(("hot", "found"), [(2, []), (12, ["exposure"])])
def test_few_hot_sensels_of_a_small_white_do_not_clip_it(hot, found):
    codes = np.random.default_rng(hot).normal(2400, 20, (60, 90)).round().astype(np.uint16)
    codes[np.arange(hot) * 4 + 3, np.arange(hot) * 6 + 5] = FULL
    frame = FrameOfSet("01 white", "white", "white", FACTS, measure_frame(codes, full=FULL), full=FULL, black=0)  # fmt: skip
    assert [f.check for f in judge([frame])["01 white"]] == found
