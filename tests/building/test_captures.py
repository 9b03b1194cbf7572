"""One table of what goes wrong with captures of any kind of camera: values are right within sigma, or told, flagged, refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from cameras import (
    BLACK,
    KINDS,
    SHAPE,
    Made,
    brighter,
    developed,
    drop,
    errors,
    frames,
    own_sensels,
    region,
    reshot,
    set_at,
    text,
    tones,
    write,
)
from scipy.ndimage import gaussian_filter, shift

from levkas.core.cube import Flag

Check = Callable[[Made, str], object]
TONES = tones(SHAPE)[0]
Y, X = np.indices(SHAPE)


# --- what is expected ---------------------------------------------------------------------------


def right(
    bias: float = 0.004,
    spread: tuple[float, float] | None = (0.9, 1.1),
    truth: np.ndarray | None = None,
) -> Check:
    """Expect values without bias, whose errors are those that sigma says."""

    def check(made: Made, kind: str) -> None:
        off, error, found = errors(made, kind, truth)
        assert abs(off) < bias + 4 * error, (off, error)
        assert spread is None or spread[0] < found < spread[1], found

    return check


def quiet(made: Made, kind: str) -> None:
    """Expect no warning."""
    assert made.words == []


def told(*tokens: str) -> Check:
    """Expect one warning with all of some numbers, labels, files and keys."""

    def check(made: Made, kind: str) -> None:
        assert made.told(*tokens), made.words

    return check


def untold(*tokens: str) -> Check:
    """Expect no warning with all of some tokens."""

    def check(made: Made, kind: str) -> None:
        assert not made.told(*tokens), made.words

    return check


def refused(code: str, file: str = "", field: str | None = None, **more: object) -> Check:
    """Expect a refusal: code, part of the file's name, field, and what was found or expected."""

    def check(made: Made, kind: str) -> None:
        assert made.problems, made.words
        first = made.problems[0]
        assert (first.code, field or first.field) == (code, first.field), first
        assert file in (first.file or ""), first
        for name, value in more.items():
            assert getattr(first, name) == value, first

    return check


def flagged(flag: int, where: np.ndarray, most: float = 0.02, least: float = 0.98) -> Check:
    """Expect a flag where `where`, (h, w), is set, and hardly anywhere else."""

    def check(made: Made, kind: str) -> None:
        found = (own_sensels(made.cube.flags, kind) & flag == flag).any(2)
        assert found[where].mean() >= least if where.any() else True
        assert found[~where].mean() <= most, found[~where].mean()

    return check


def recorded(path: str, value: float | None, **tolerance: float) -> Check:
    """Expect a number in what was measured, or with None that nothing is."""

    def check(made: Made, kind: str) -> None:
        found: Any = made.measured
        *before, last = path.split("/")
        for name in before:
            found = next(iter(found.values())) if name == "*" else found[name]
        if value is None:
            assert last not in found
        else:
            assert found[last] == pytest.approx(value, **tolerance)

    return check


def budgeted(source: str, value: float, **tolerance: float) -> Check:
    """Expect the largest size of a row of the budget."""

    def check(made: Made, kind: str) -> None:
        assert max(made.budget[source].size.values()) == pytest.approx(value, **tolerance)

    return check


class Row(NamedTuple):
    """A fault: of which kinds of camera, by what habits, by what changes of the files, and what is expected."""

    name: str
    kinds: str
    habits: dict[str, Any]
    changes: Sequence[Callable]
    checks: Sequence[Check]


ALL = " ".join(KINDS)
LAMP = "lamp between white and object"
GOLD = (Y >= 20) & (Y < 60) & (X >= 40) & (X < 80)
GILT = np.where(GOLD, 1.275, 0.9 * TONES)
SPOT = (slice(20, 36), slice(20, 36))
HIT = np.zeros(SHAPE, bool)
HIT[22:34, 22:34] = True
PLACE = (20, 25)
DOT = np.zeros(SHAPE, bool)
DOT[PLACE] = True
NOWHERE = np.zeros(SHAPE, bool)
SERIES = {"series": (0.25, 0.5, 1.0), "light": 3300.0}
BRACKET = {"series": (0.25, 1.0, 4.0)}
"""Whose longest white is full: it is dropped where it is not wanted."""
PANEL_AT_HALF = [drop("panel_*250ms_*", "panel_*1000ms_*"), text('"merge"', '"best"')]
ONE_TIME = {"series": (0.25, 0.5), "light": 6000.0, "current": 40.0}
OTHER_DARK = [drop("dark_*_500ms_*", "white_*_500ms_*", "panel_*_250ms_*"), text('"merge"', '"best"')]  # fmt: skip
BLACK_OF_FRAMES = {"extratags": [(50714, "H", 1, int(BLACK), True)]}


def panel(seed: int) -> np.ndarray:
    """A painting with detail of every size, 0.06 to 0.86."""
    rng = np.random.default_rng(seed)
    layers = [gaussian_filter(rng.standard_normal(SHAPE), s) * s for s in (2, 4, 8)]
    return 0.06 + 0.8 / (1 + np.exp(-3 * sum(layers)))


PAINTED = {"truth": panel(1), "shots": (2, 2, 3)}
UNLIKE = {
    "scene": panel(2),
    "place": shift(panel(1), (0, 6), mode="nearest"),
    "light": panel(1) * np.linspace(0.5, 1.5, SHAPE[1]),
    "exposure": 1.26 * panel(1),
}
SECOND = "panel*_1.tif"


def without_times(folder: Path) -> None:
    """Take the exposure out of names of the white."""
    for path in (folder / "raw").glob("white*.hdr"):
        said = path.read_text()
        path.write_text("".join(x for x in said.splitlines(True) if not x.startswith("tint")))


def clipped_codes(bits: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return what leaves the upper bits of 12, stretched to 12 again."""
    return lambda codes: np.round((codes >> (12 - bits)) * (4095 / (2**bits - 1))).astype("u2")


def dithered(codes: np.ndarray) -> np.ndarray:
    """Whole codes that are as close to each other as they were."""
    rng = np.random.default_rng(4)
    return np.rint(codes + rng.uniform(-2, 2, codes.shape)).clip(0, 65535).astype(np.uint16)


def dark_is_dark(made: Made, kind: str) -> None:
    """Expect the mean of what has no light to be none."""
    assert abs((made.cube.values / made.cube.sigma)[~GOLD].mean()) < 0.4


def smaller(codes: np.ndarray) -> np.ndarray:
    """A frame that lacks its last columns."""
    return codes[:, :-4]


ROWS = [
    Row("all is as it should be", ALL, {}, [], [right(), quiet, recorded("sensor/gain", 0.25, rel=0.1)]),
    Row("single shots", "bands", {"shots": (1, 1, 1)}, [], [right(0.006, None), told("single")]),

    # pixels that are no numbers
    *(Row(f"{value} in a {target}", "bands", {}, [set_at(f"{target}_550nm_*.tif", PLACE, value)],
          [right(), flagged(Flag.DEFECT, DOT, 0.003, 1), told("550 nm: 1 of")])
      for target, value in (("panel", np.nan), ("white", np.inf), ("dark", -np.inf))),
    *(Row(f"nan in the {target} of a scan", "cube mirror", {}, [set_at(f"{target}.hdr", (7, 5, 2), np.nan)],
          [right(), told("not finite numbers") if target == "panel" else right()])
      for target in ("panel", "white", "dark")),
    *(Row(f"no finite value in a {target}", "bands", {}, [set_at(f"{target}_650nm_*.tif", ..., np.nan)],
          [refused("E_VALUE", f"{target}_650nm", "pixels")]) for target in ("panel", "white", "dark")),
    Row("no finite value in a band of a scan", "cube", {}, [set_at("panel.hdr", np.s_[..., 1], np.nan)],
        [refused("E_VALUE", "panel.hdr")]),

    # bits and codes
    Row("8 bits where 12 are said", "bands", {}, [frames("*.tif", lambda c: (c >> 4).astype("u1"))],
        [refused("E_BITS", field="cameras.cam.bits")]),
    Row("a code beyond the bits", "bands mosaic", {}, [set_at("panel*_0.tif", PLACE, 4096, "u2")],
        [refused("E_BITS", "panel", found="4096", expected="at most 4095")]),
    Row("codes at the upper end of 16 bits", "bands", {"shift": 16, "keys": "bits = 12\nsaturation = 65520\n"}, [],
        [right(), quiet]),
    Row("8 bits stretched to 12", "bands", {"vignette": 0.6}, [frames("*.tif", clipped_codes(8)), frames("dark*", lambda c: 0 * c + 64)], [told("8 bits", "12")]),
    Row("8 bits in the lower end", "bands", {}, [frames("*.tif", lambda c: c >> 4)], [told("bits")]),

    # sizes
    *(Row(f"a {target} of another size", ALL, {}, [frames(f"{target}*", smaller)],
          [refused("E_SIZE", target)]) for target in ("dark", "white")),
    Row("one white of another size", "bands", {}, [frames("white_650nm_*", smaller)],
        [refused("E_SIZE", "white_650nm", found="96 x 80", expected="100 x 80")]),
    Row("a band of another size", "bands", {}, [frames("*_550nm_*", smaller)],
        [refused("E_SIZE", "panel_550nm", found="96 x 80", expected="100 x 80")]),
    Row("frames smaller than their pattern", "mosaic", {},
        [frames("*.tif", lambda c: c[:2]), text('"RGGB"', '[["A", "B"], ["C", "D"], ["E", "F"]]')],
        [refused("E_SIZE", found="100 x 2", expected="at least 2 x 3")]),
    Row("shots of two sizes", "bands", {}, [frames("panel_550nm_1.tif", smaller)], [refused("E_SIZE", "panel_550nm")]),
    Row("templates of one line", "cube", {"truth": 0.3 + 0 * TONES},
        [frames("[dw]*.hdr", lambda c: c[:1])], [lambda made, kind: made.cube.sigma is None or 1 / 0,
         lambda made, kind: made.cube.values.mean() == pytest.approx(0.3, rel=0.02) or 1 / 0]),

    # black
    *(Row(f"darks clipped at {black:g}", ALL, {"black": black, "shots": (8, 6, 2)}, [], [right(0.004, (0.85, 1.15))])
      for black in (0.0, 3.0)),
    Row("what is fitted to clipped darks is recorded", "bands", {"black": 0.0, "shots": (8, 4, 2)}, [],
        [recorded("clipped_darks/*/noise", 2.5, rel=0.08), told("clipped", "black")]),
    Row("darks of nothing but zeros", "bands", {"black": 0.0},
        [frames("dark*", lambda c: 0 * c)], [told("black level")]),
    Row("hot sensels of clipped darks", "bands", {"black": 0.0},
        [frames("*.tif", lambda c: np.where(DOT, np.minimum(c + 900, 4095), c).astype("u2"))],
        [flagged(Flag.DEFECT, DOT, 0.003, 1)]),
    Row("hot sensels", "bands mosaic", {},
        [frames("*.tif", lambda c: np.where(DOT, np.minimum(c + 900, 4095), c).astype("u2"))],
        [flagged(Flag.DEFECT, DOT, 0.02, 1), right()]),
    Row("phases of their own black", "mosaic", {"phases": (-20.0, 0.0, 5.0, 20.0)}, [], [right(), quiet]),
    Row("black level wanders", "bands", {"wander": 8.0, "clock": 10.0}, [], [told("black"), budgeted("black level", 0.00138, rel=0.5)]),
    Row("black declared, no darks", "bands cube", {"keys": f"bits = 12\nblack = {BLACK:g}\n"},
        [text('dark = "dark"\n', "")], [right(0.004, None)]),

    Row("shots that are clipped are no brighter on the mean", "bands", {"black": 0.0, "shots": (8, 6, 8), "truth": np.where(GOLD, 0.8, 0.0)}, [],
        [flagged(Flag.BLACK, ~GOLD, 1, 0.95), dark_is_dark]),

    # exposures
    Row("exposures are merged", "bands mosaic", BRACKET, [drop("white_*4000ms_*")],
        [right(), flagged(Flag.MOVED, NOWHERE, 0.001)]),
    Row("an exposure that took a third more", "bands", SERIES, [brighter("panel_*_500ms_*", 1.2)],
        [refused("E_EXPOSURES")]),
    Row("of two exposures one is wrong", "bands", SERIES,
        [drop("*_500ms_*", "white_*_250ms*"), brighter("panel_*_250ms_*", 4 / 3)], [refused("E_EXPOSURES")]),
    Row("something moved between exposures", "bands", SERIES, [region("panel_*_1000ms_*", SPOT, 0.3)],
        [flagged(Flag.MOVED, HIT, 0.06, 0.9)]),
    Row("the longest white that is not full counts", "bands", BRACKET,
        [drop("panel_*_250ms_*", "panel_*_4000ms_*"), text('"merge"', '"best"')], [right()]),
    Row("a white of another time, in a series", "bands", SERIES, PANEL_AT_HALF, [right(), untold("linear")]),
    Row("a white that took longer than it says", "bands", SERIES,
        [*PANEL_AT_HALF, brighter("white_*_1000ms_*", 1.06)], [refused("E_EXPOSURES")]),
    Row("white and object of two times, no series", "bands mosaic", SERIES,
        [*PANEL_AT_HALF, drop("white_*250ms_*", "white_*500ms_*")], [right(), told("1 s", "0.5 s")]),
    Row("a dark of another time", "bands", ONE_TIME, OTHER_DARK, [refused("E_EXPOSURES", field="black")]),
    Row("a dark of another time, black declared", "bands", ONE_TIME,
        [*OTHER_DARK, text("bits = 12", f"bits = 12\nblack = {BLACK:g}")], [right()]),
    Row("a dark of another time, black in the frames", "bands", ONE_TIME,
        [*OTHER_DARK, frames("*.tif", lambda c: c, **BLACK_OF_FRAMES)], [right()]),
    Row("darks of two other times", "bands", {"series": (0.25, 0.5, 1.0), "current": 40.0},
        [drop("dark_*_500ms_*", "white_*_[25]*ms_*", "panel_*_250ms_*", "panel_*_1000ms_*"), text('"merge"', '"best"')],
        [right()]),
    Row("the black level of a series scales a dark", "bands", SERIES | {"current": 60.0},
        [drop("dark_*_500ms_*", "dark_*_1000ms_*")], [recorded("black/counts", BLACK, abs=0.7), right(0.01, None)]),
    Row("a bend of 1.5 %", "bands", SERIES | {"curve": 0.015}, [], [told("linear"), recorded("straightness", 0.012, rel=0.5)]),
    Row("a bend that is refused", "bands mosaic", SERIES | {"response": lambda c: np.where(c < 1500, c, 300 + 0.8 * c)}, [],
        [refused("E_EXPOSURES")]),
    Row("a straight series", "bands", SERIES | {"shots": (4, 4, 1)}, [], [right(), quiet]),
    Row("a lamp that flickers between exposures", "bands", SERIES,
        [brighter("panel_*_500ms_*", 1.012), brighter("panel_*_250ms_*", 0.995)], [untold("linear"), told("lamp"), right(0.02, None)]),
    Row("darks that are too warm, in a series", "bands", SERIES, [frames("dark*", lambda c: c + np.uint16(5))],
        [recorded("offset/counts", -5.0, abs=0.7), told("-")]),
    Row("darks that are right, in a series", "bands", SERIES, [], [recorded("offset", None)]),
    *(Row("twice the time, the same counts", kind, {"seconds": (1.0, 1.0, 2.0), "current": 0.0, "truth": 0.4 + 0 * TONES,
           "keys": f"bits = 12\nblack = {BLACK:g}\n"}, [text('dark = "dark"\n', "")], [right(truth=0.4 + 0 * TONES, spread=None), told("linear")])
      for kind in ("cube", "mirror", "bands")),
    Row("a scan whose dark has another time", "cube mirror", {"seconds": (1.0, 1.0, 2.0), "current": 20.0, "light": 1500.0}, [],
        [refused("E_EXPOSURES", field="black")]),
    Row("a scan whose white says no time", "cube", {"seconds": (1.0, 1.0, 2.0), "light": 1500.0}, [without_times],
        [refused("E_EXPOSURES", "white.hdr")]),

    # full scale
    Row("full below the bits", "bands mosaic cube mirror", {"top": 3600.0, "truth": GILT}, [],
        [flagged(Flag.SATURATED, GOLD, 0.1), told("3600", "12 bits"), recorded("full_scale/counts", 3600)]),
    Row("a full well with read noise behind it", "bands", {"full": 3500.0, "truth": GILT, "light": 3200.0}, [],
        [flagged(Flag.SATURATED, GOLD)]),
    Row("full at the stated bits", "bands mosaic cube mirror", {"truth": np.where(GOLD, 1.5, TONES)}, [],
        [flagged(Flag.SATURATED, GOLD, 0.1), recorded("full_scale", None)]),
    Row("a white that is full", "bands mosaic cube mirror", {"light": 6000.0}, [], [refused("E_WHITE_SATURATED", "white")]),
    Row("a white that is full below the bits", "bands mosaic cube", {"light": 6000.0, "top": 3600.0}, [],
        [refused("E_WHITE_SATURATED", "white")]),
    Row("a white that is full, bits unknown", "bands mosaic cube", {"light": 6000.0, "keys": ""}, [],
        [refused("E_WHITE_SATURATED", "white")]),
    Row("a white of a scan that is full everywhere", "cube mirror", {"full": 2940.0, "light": 3600.0, "truth": 0.5 * TONES}, [],
        [told("noise", "dark")]),

    # noise
    *(Row(f"a band of {gain:g} times the gain", "bands", {"keys": "bits = 16\n", "shots": (4, 4, 3)},
          [frames("*_550nm_*", lambda c, gain=gain: dithered(gain * c))],
          [right(), told("band to band", "gain")]) for gain in (4, 0.5)),
    Row("channels that were multiplied", "mosaic", {"keys": "bits = 16\n", "shots": (4, 4, 3)},
        [frames("*.tif", lambda c: np.rint(c * np.tile([[2.0, 1.0], [1.0, 1.6]], (40, 50))).astype("u2"))],
        [told("band to band")]),
    Row("one gain under a lamp that flickers", "bands", {"flicker": 0.02, "keys": "bits = 16\n"}, [],
        [untold("band to band"), recorded("unlike_noise", None)]),

    # shots that are none
    *(Row(f"a shot of another {what}", "bands mosaic sensors", PAINTED, [reshot(SECOND, scene)],
          [refused("E_UNLIKE_SHOTS", "_1.tif", what)]) for what, scene in UNLIKE.items()),
    Row("a shot of 5 % less light", "bands mosaic sensors", PAINTED, [reshot(SECOND, 0.95 * panel(1))],
        [lambda made, kind: made.cube]),
    Row("a hand before a white", "bands mosaic", {"shots": (4, 4, 2)}, [region("white*_2.tif", SPOT, 0.4)],
        [refused("E_UNLIKE_SHOTS", "_2.tif")]),
    Row("half of the whites are another", "bands", {"shots": (4, 4, 2)},
        [region("white*_[02].tif", SPOT, 0.4)], [refused("E_UNLIKE_SHOTS", "white")]),

    # the white
    Row("the painting in a part of the white", "bands mosaic cube", {"strip": 0.3, "shape": (100, 140)}, [], [told("columns 0")]),
    Row("a white that is the object", "bands", {"strip": 1.0, "shape": (100, 140)}, [], [refused("E_WHITE_DETAIL", "white_450nm")]),
    Row("another painting for a white", "bands mirror", {}, [reshot("white*[!w]", panel(5))],
        [refused("E_WHITE_DETAIL", "white")]),
    Row("an uneven lamp", ALL, {"vignette": 0.5}, [], [right(), quiet]),

    # light
    *(Row(f"a {target} without light", "bands cube", {}, [reshot(f"{target}*[!w]", 0 * TONES)], [refused(code, target)])
      for target, code in (("panel", "E_NO_LIGHT"), ("white", "E_WHITE_DARK"))),
    Row("dark and white exchanged", "bands mirror", {}, [text('dark = "dark"', 'dark = "white"'), text('names = "white"', 'names = "dark"')],
        [refused("E_WHITE_DARK")]),
    Row("a band without light", "bands", {}, [reshot("panel_550nm_*", 0 * TONES)], [told("550 nm", "1 of 3")]),
    *(Row(f"a {target} of one value", "bands", {"shots": (1, 1, 1)}, [set_at(f"{target}_550nm_0.tif", ..., value, "u2")],
          [refused(code, f"{target}_550nm")])
      for target, value, code in (("panel", 1000, "E_CONSTANT"), ("white", BLACK, "E_WHITE_DARK"))),
    *(Row(f"an object {times:g} times its white in one band", "bands", {"light": 900.0}, [reshot("panel_550nm_*", np.full(SHAPE, times))],
          [told("550 nm", "1 of 3")]) for times in (0.45, 1.2)),
    Row("much noise above the white", "bands", {"read": 200.0, "light": 1500.0, "black": 1000.0}, [], [untold("perfect white")]),
    Row("some gold", "bands cube", {"light": 1500.0, "truth": np.where((Y % 10 == 0) & (X % 7 == 0), 1.5, 0.7 * TONES)}, [],
        [untold("perfect white")]),

    # the lamp
    Row("a lamp that drifts within the white", "bands mosaic", {"drift": 0.05, "shots": (4, 6, 3)}, [],
        [recorded("sensor/gain", 0.25, rel=0.1), told("lamp"), right(0.06, None)]),
    Row("whites before and after, times stated", "bands", {"drift": 0.05, "after": 3, "clock": 10.0, "shots": (4, 6, 3)}, [],
        [right(0.004, None), budgeted(LAMP, 0.025, rel=0.4)]),
    Row("a steady lamp", "bands", {"shots": (4, 6, 3)}, [], [untold("lamp")]),
    Row("a lamp that sinks along a scan", "cube", {"drift": 0.08, "shape": (240, 100)}, [], [told("lamp"), budgeted(LAMP, 0.07, rel=0.4)]),
]  # fmt: skip


CASES = [(row, kind) for row in ROWS for kind in row.kinds.split()]
MOST = 2
"""Kinds of camera of a row that every run takes; all of them where $LEVKAS_EVERY_CASE is set."""


@pytest.mark.parametrize(
    ("row", "kind"),
    [
        pytest.param(
            row,
            kind,
            id=f"{row.name}, {kind}",
            marks=[pytest.mark.exhaustive]
            * (row.kinds.split().index(kind) >= MOST and len(row.habits) + len(row.changes) > 0),
        )
        for row, kind in CASES
    ],
)
def test_a_capture_is_right_or_told_or_refused(row, kind, tmp_path):
    made = developed(write(tmp_path / "c", kind, *row.changes, **row.habits))
    for check in row.checks:
        check(made, kind)
