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
    FrameFinding,
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
    measures = measure_frame(codes, full=FULL)
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


def half_covered(share: float) -> np.ndarray:
    return np.where(np.arange(WIDTH) < share * WIDTH, PANEL, 0.98)


def moved(down: float, right: float) -> np.ndarray:
    return shift(PANEL, (down, right), mode="nearest")


def lit_dark(level: float) -> np.ndarray:
    return level * np.linspace(0, 1, WIDTH) * np.ones((HEIGHT, 1))


CASES = {
    "white at full scale": ("exposure", "08 white", lambda: expose(0.98, 8, lamp=1.6), {}),
    "object at full scale": ("exposure", "07 shot", lambda: expose(PANEL, 7, lamp=1.8), {}),
    "dark with a little light": ("dark", "02 dark", lambda: expose(lit_dark(0.02), 2), {}),
    "black level": ("black", "02 dark", lambda: expose(0.0, 2, black=BLACK + 30), {}),
    "dark of another time": ("dark", "07 shot", lambda: expose(PANEL, 7), {"exposure_s": 0.2}),
    "white with some of the painting": ("white", "04 white", lambda: expose(half_covered(0.2), 4), {}),
    "white that is the painting": ("white", "04 white", lambda: expose(PANEL, 4), {}),
    "lamp sank by 4 %": ("drift", "08 white", lambda: expose(0.98, 8, lamp=0.96), {}),
    "lamp sank by 12 %": ("drift", "08 white", lambda: expose(0.98, 8, lamp=0.88), {}),
    "lamp sank in the stack": ("drift", "07 shot", lambda: expose(PANEL, 7, lamp=0.98), {}),
    "noise, a little": ("noise", "07 shot", lambda: expose(PANEL, 7, noise=1.5), {}),
    "noise of a dark": ("noise", "02 dark", lambda: expose(0.0, 2, noise=2), {}),
    "focus, a little": ("focus", "07 shot", lambda: expose(gaussian_filter(PANEL, 1.6), 7), {}),
    "focus": ("focus", "07 shot", lambda: expose(gaussian_filter(PANEL, 3), 7), {}),
    "moved by 0.9 px": ("moved", "07 shot", lambda: expose(moved(0.5, 0.75), 7), {}),
    "moved by 1.5 px": ("moved", "07 shot", lambda: expose(moved(0.9, 1.2), 7), {}),
    "another panel": ("moved", "07 shot", lambda: expose(PANEL[::-1, ::-1], 7), {}),
    "another light": ("drift", "07 shot", lambda: expose(PANEL * np.linspace(0.5, 1.4, WIDTH), 7), {}),
    "another exposure": ("drift", "07 shot", lambda: expose(PANEL, 7, lamp=0.79), {}),
    "glare": ("glare", "07 shot", lambda: expose(blob(50), 7, lamp=0.95), {}),
    "another ISO": ("settings", "07 shot", lambda: expose(PANEL, 7), {"facts": replace(FACTS, iso=200.0)}),
    "another size": ("settings", "07 shot", lambda: expose(PANEL, 7)[:-20, :-20], {}),
}  # fmt: skip


def judged(case: str, rules: SetRules | None = None) -> dict[str, list[FrameFinding]]:
    """Return the findings of the good session with a fault; what its frames get is known already to the usual judge."""
    _, name, codes, given = CASES[case]
    faulty = frame(name, good_frames()[name].role, codes(), **given)
    frames = {**good_frames(), name: faulty}.values()
    return judge(frames, rules) if rules else copy(warm_judge()).judge(frames)


def test_a_good_session_has_no_finding():
    assert {name: found for name, found in judge(good_frames().values()).items() if found} == {}


@pytest.mark.parametrize("case", CASES)
def test_a_planted_fault_is_named_at_its_frame(case):
    check, name, *_ = CASES[case]
    found = judged(case)
    assert check in [one.check for one in found[name]]
    assert all(one.text and one.advice for one in found[name])
    others = [n for n, some in found.items() if some and n != name and n > name[:2]]
    assert len(others) <= 1  # a shot or white after it that is compared with the faulty one


def test_small_and_large_differ_in_severity():
    pairs = (("moved by 0.9 px", "moved by 1.5 px"), ("lamp sank by 4 %", "lamp sank by 12 %"))
    for pair in (*pairs, ("focus, a little", "focus")):
        assert [worst(judged(case)[CASES[case][1]]) for case in pair] == ["look", "stop"], pair


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("case", ["another panel", "another light", "another exposure"])
def test_what_a_build_refuses_is_no_shot_while_the_session_lasts(case, plain):
    check, name, *_ = CASES[case]
    found = judged(case, SetRules(plain=plain))[name]
    assert ("stop", check) in [(one.severity, one.check) for one in found]


def test_findings_hang_on_the_set_and_not_on_the_order_of_coming():
    _, name, codes, _ = CASES["lamp sank by 4 %"]
    frames = list({**good_frames(), name: frame(name, "white", codes())}.values())
    whole = judge(frames)
    growing = FrameJudge()
    for count in (1, 4, 6, len(frames)):
        found = growing.judge(reversed(frames[-count:]))
    assert found == whole
    assert growing.judge(frames[:-1]) == judge(frames[:-1])  # one was deleted


def test_what_a_campaign_allows_is_no_finding():
    assert judged("another ISO", SetRules(overrule=("iso",)))["07 shot"] == []
    brackets = judged("object at full scale", SetRules(brackets=True))["07 shot"]
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
    assert [n for n, some in found.items() if some] == [name]


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


def test_a_frame_that_came_twice_names_the_first():
    codes = expose(PANEL, 7)
    frames = {**good_frames(), "09 shot": frame("09 shot", "object", codes)}.values()
    found = judge([f for f in frames if f.name != "06 shot"])
    assert [one.check for one in found["09 shot"]] == ["twice"]


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
