"""Every assumption of calibration broken at two sizes, through whole builds: right within sigma, or named.

    python tests/promises/table.py [NAME …]

prints a table: what a build says, or how far its values lie from the truth.
"""

from __future__ import annotations

import re
import sys
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from camera import Habits, Outcome, outcome_of, tones, write_campaign

DECADES = (0.002, 0.01, 0.1, 1.01)
BIAS = 0.003
"""Relative, of the mean of a decade, beyond three standard errors of that mean."""
SPREAD = (0.9, 1.1)
"""Of (R − truth) over sigma; the goal of 0.95–1.05 is for frames large enough to show it."""


@dataclass(frozen=True)
class Case:
    """One assumption, broken: by what habits and keys, and the words that name it."""

    name: str
    size: str
    kind: str
    habits: dict[str, Any]
    options: dict[str, Any]
    words: str
    stated: str = ""
    """What the camera's page says where a build cannot find it out."""

    @property
    def label(self) -> str:
        """Assumption, size and kind of camera."""
        return f"{self.name}, {self.size} ({self.kind})"


STRAY, STRAY_UNKNOWN = "stray light", "stray light was not measured"
LAMP = "how the lamp changed was not measured"
LAMP_UNDETECTED = "whether the lamp changed all at once"
CHART = np.array([
    (0.062, 0.084, 0.179), (0.213, 0.276, 0.595), (0.331, 0.185, 0.147), (0.061, 0.17, 0.112), (0.426, 0.208, 0.313),
    (0.381, 0.488, 0.188), (0.055, 0.199, 0.584), (0.4, 0.096, 0.098), (0.128, 0.093, 0.591), (0.139, 0.051, 0.166),
    (0.075, 0.546, 0.31), (0.066, 0.431, 0.648), (0.309, 0.042, 0.042), (0.066, 0.293, 0.092), (0.047, 0.05, 0.675),
    (0.059, 0.65, 0.764), (0.306, 0.102, 0.732), (0.353, 0.185, 0.074), (0.884, 0.914, 0.923), (0.59, 0.59, 0.576),
    (0.363, 0.361, 0.348), (0.194, 0.192, 0.182), (0.092, 0.09, 0.085), (0.033, 0.032, 0.032),
])  # fmt: skip
"""Published reflectances of a ColorChecker at 450, 550 and 650 nm (BabelColor)."""


def _cases() -> list[Case]:
    rows: list[tuple[str, str, dict, dict, str, str]] = [
        # name, kinds, size → habits (two of them), options, what the page states, words that name it
        ("black level 0, darks clipped", "bands mosaic sensors cube mirror",
         {"read noise 1 count": {"black": 0.0, "read": 1.0}, "2.5 counts": {"black": 0.0}}, {}, "", ""),
        ("black level 0, single shots", "bands mosaic",
         {"read noise 1 count": {"black": 0.0, "read": 1.0, "shots": (1, 1, 1)},
          "2.5 counts": {"black": 0.0, "shots": (1, 1, 1)}}, {}, "", "single shots"),
        ("darks clipped in part", "bands cube",
         {"black 2": {"black": 2.0}, "black 4": {"black": 4.0}}, {}, "", ""),
        ("phases of their own black", "mosaic",
         {"4 counts": {"phases": (-4.0, 0.0, 2.0, 4.0)}, "20 counts": {"phases": (-20.0, 0.0, 5.0, 20.0)}}, {}, "", ""),
        ("uneven white", "bands mosaic cube",
         {"20 %": {"vignette": 0.2}, "60 %": {"vignette": 0.6}}, {}, "", ""),
        ("lamp drifts within the stacks", "bands mosaic sensors cube mirror",
         {"2 %": {"drift": 0.02}, "5 %": {"drift": 0.05}}, {}, LAMP, r"drift|lamp"),
        ("lamp sinks over a scan of 480 lines", "cube",
         {"2 %": {"drift": 0.02}, "5 %": {"drift": 0.05}}, {"shape": (480, 200)}, LAMP_UNDETECTED, r"drift|lamp"),
        ("lamp sinks over a scan of 1500 lines", "cube",
         {"2 %": {"drift": 0.02}, "5 %": {"drift": 0.05}}, {"shape": (1500, 200)}, LAMP_UNDETECTED, r"drift|lamp"),
        ("lamp drifts, whites on both sides, times stated", "bands mosaic sensors",
         {"2 %": {"drift": 0.02, "after": 3, "clock": 10.0}, "5 %": {"drift": 0.05, "after": 3, "clock": 10.0}},
         {}, LAMP, r"drift|lamp"),
        ("lamp flickers", "bands mosaic cube",
         {"0.5 %": {"flicker": 0.005}, "2 %": {"flicker": 0.02}}, {}, LAMP, r"drift|lamp|flicker"),
        ("lamp reddens", "bands cube",
         {"2 %": {"reddening": 0.02}, "5 %": {"reddening": 0.05}}, {}, LAMP, r"drift|lamp"),
        ("full well below the top code", "bands mosaic cube",
         {"3600 counts": {"full": 3600.0, "light": 3520.0}, "3000 counts": {"full": 3000.0, "light": 2950.0}},
         {}, "", r"full|saturat"),
        ("white over the full well", "bands mosaic cube",
         {"3600 counts": {"full": 3600.0, "light": 3900.0}, "3000 counts": {"full": 3000.0, "light": 3300.0}},
         {}, "", r"full|saturat"),
        ("12 bits, not declared", "bands mosaic cube",
         {"white full": {"light": 4400.0}, "white right": {}}, {"keys": ""}, "", r"full|saturat"),
        ("dark of another time", "bands cube",
         {"twice": {"seconds": (2.0, 1.0, 1.0), "current": 20.0}, "eight times": {"seconds": (8.0, 1.0, 1.0), "current": 20.0}},
         {}, "", r"dark|black"),
        ("black level wanders", "bands mosaic",
         {"2 counts": {"wander": 2.0}, "8 counts": {"wander": 8.0}}, {}, "", r"black|dark"),
        ("response bends, merged series", "bands mosaic",
         {"2 %": {"curve": 0.02, "series": (0.25, 0.5, 1.0)}, "6 %": {"curve": 0.06, "series": (0.25, 0.5, 1.0)}},
         {}, "", r"linear|curve|proportional"),
        ("white and object of unlike ISO", "bands mosaic",
         {"100, 125": {"iso": (100, 125)}, "100, 200": {"iso": (100, 200)}}, {}, "", r"(?i)iso"),
        ("white and object of unlike stop", "bands mosaic",
         {"f/8, f/9": {"stop": (8.0, 9.0)}, "f/5.6, f/8": {"stop": (5.6, 8.0)}}, {}, "", r"f-number|f/"),
        ("painting in the white", "bands mosaic cube",
         {"5 % of the columns": {"strip": 0.05}, "30 %": {"strip": 0.3}}, {}, "", r"white"),
        ("stray light, a chart is there", "bands",
         {"5 % of the mean of the view": {"stray": 0.05}, "15 %": {"stray": 0.15}}, {"chart": CHART}, STRAY_UNKNOWN, STRAY),
        ("stray light, no chart", "bands mosaic", {"1 %": {"stray": 0.01}, "5 %": {"stray": 0.05}}, {}, STRAY_UNKNOWN, STRAY),
        ("codes shifted to the upper end", "bands",
         {"16-fold": {"shift": 16}, "4-fold": {"shift": 4}}, {"keys": ""}, "", r"bits|code"),
    ]  # fmt: skip
    return [
        Case(name, size, kind, habits, options, words, stated)
        for name, kinds, sizes, options, stated, words in rows
        for kind in kinds.split()
        for size, habits in sizes.items()
    ]


CASES = _cases()
PLAIN = [
    Case("no promise broken", "none", kind, {}, {}, "")
    for kind in ("bands", "mosaic", "sensors", "cube", "mirror")
]


def run(case: Case, folder: Path) -> Outcome:
    """Write and build a case."""
    from levkas.building.run import build

    write_campaign(folder, case.kind, Habits(**case.habits), **case.options)
    return outcome_of(folder, build)


CLIPPED = 4
"""Flag of a pixel of which a shot was clipped at black. It counts: without these the others are too bright on average."""


class Decade(NamedTuple):
    """How one band did in one decade of reflectance: relative bias with its standard error, spread over sigma."""

    band: int
    low: float
    high: float
    pixels: int
    bias: float
    error: float
    spread: float


def decades(made: Outcome, tone: np.ndarray, inner: np.ndarray) -> list[Decade]:
    """Compare values with a truth, (h, w), where `inner`, (h, w) or (h, w, bands), is set and nothing is flagged."""
    values, sigma, flags = made.values, made.sigma, made.flags
    assert values is not None and flags is not None
    found = []
    where = np.broadcast_to(inner if inner.ndim == 3 else inner[..., None], values.shape)
    for band in range(values.shape[2]):
        for low, high in pairwise(DECADES):
            good = (
                where[..., band]
                & (tone >= low)
                & (tone < high)
                & (flags[..., band] & ~np.uint8(CLIPPED) == 0)
            )
            if (count := int(good.sum())) < 300:
                found.append(Decade(band, low, high, count, np.nan, np.nan, np.nan))
                continue
            ratio = values[..., band][good] / tone[good] - 1
            # Pixels of a tile may share noise, as demosaiced ones do: tiles are independent.
            _, tile = np.unique(tone[good], return_inverse=True)
            weight = np.bincount(tile)
            means = np.bincount(tile, ratio) / weight
            bias = float(np.average(means, weights=weight))
            error = np.sqrt(np.average((means - bias) ** 2, weights=weight) / (len(means) - 1))
            known = np.inf if sigma is None else sigma[..., band][good]
            spread = ((values[..., band][good] - tone[good]) / known).std()
            found.append(Decade(band, low, high, count, bias, float(error), float(spread)))
    return found


def misses(made: Outcome) -> list[str]:
    """Return the decades of bands whose bias or spread are beyond what is allowed, in words."""
    assert made.values is not None
    found = []
    for one in decades(made, *tones(made.values.shape[:2])):
        where = f"band {one.band}, {one.low:g}–{one.high:g}"
        if np.isnan(one.bias):
            found.append(f"{where}: {one.pixels} pixels unflagged")
            continue
        if abs(one.bias) > BIAS + 3 * one.error:
            found.append(f"{where}: bias {one.bias:+.2%}")
        if not SPREAD[0] <= one.spread <= SPREAD[1]:
            found.append(f"{where}: spread {one.spread:.2f}")
    return found


def judge(case: Case, made: Outcome) -> tuple[str, list[str]]:
    """Return "right", "refused", "named", "stated" or "silent", and what is off.

    "stated" is what no build can find out, where the camera's page says that it was not measured.
    """
    named = bool(case.words and re.search(case.words, _own_words(made.words)))
    if made.refused:
        return ("refused" if named else "refused for another reason"), [made.words]
    off = misses(made)
    if not off:
        return "right", []
    if not named and case.stated and case.stated in made.page:
        return "stated", off
    return ("named" if named else "silent"), off


ALWAYS = re.compile(r"the reflectance of the white is assumed.*")
"""What a build says of every campaign of these."""


def _own_words(words: str) -> str:
    return ALWAYS.sub("", words)


def main() -> None:
    """Print the table."""
    wanted = sys.argv[1:]
    print("| assumption | broken by | camera | came out | what it says, or how far it is off |")
    print("|---|---|---|---|---|")
    for case in [*PLAIN, *CASES]:
        if wanted and not any(text in case.label for text in wanted):
            continue
        with tempfile.TemporaryDirectory() as folder:
            made = run(case, Path(folder) / "campaign")
        verdict, off = judge(case, made)
        said = _own_words(made.words).replace("\n", "; ").replace("|", "/")
        text = "; ".join(off[:3]) if verdict in ("silent", "stated") else said[:300]
        print(f"| {case.name} | {case.size} | {case.kind} | {verdict} | {text} |", flush=True)


if __name__ == "__main__":
    main()
