"""Pairs with little in common: real captures in light far apart, coarse, blurred and noisy, and impostors of them.

    python benchmarks/modalities.py [--pairs 100] [--impostors 200] [--seed 51] [--json OUT]
    python benchmarks/modalities.py --again OUT

Two lenses of one camera at opposite ends of its spectrum (blue or green with red edge and near infrared), a colour
camera with a mosaic camera's bands, and "heat": a channel of a real picture, of which tones are mixed anew in every place,
so that contrast vanishes or turns over from place to place, below a field of its own. Both pictures are reduced to 160 to 400 px, the
other one is blurred, turned, scaled and noisy. The map of two lenses is what full pictures are registered to (0.02 to
0.2 px of those, reduced two to six times); that of heat is exact. An impostor shows another place or scene in
the same light. A map is right where it is at most 1 px wrong in the mean, px of the reference, or of the target where
that is coarser.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from pairs import view
from results import add_option, record
from verdict_classes import DATA, judged, real_bands, sample

from levkas.geometry.transforms import Affine, Composed
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.verdict import judge_windows

RIGHT_PX = 1.0


def lens_pairs() -> list[tuple[str, np.ndarray, np.ndarray, object]]:
    """Return (name, picture, other picture, map between them) of lenses and cameras far apart in the spectrum."""
    found = []
    for number in ("0000", "0001"):
        lenses = {
            lens: np.asarray(
                read_frame(DATA / f"rededge-5lens/IMG_{number}_{lens}.tif"), np.float32
            ).squeeze()
            for lens in range(1, 6)
        }
        for one, other in ((1, 4), (2, 4), (3, 4), (1, 5), (3, 5)):
            found.append((f"lenses {number} {one} {other}", lenses[one], lenses[other]))
    for folder in ("board", "scene1", "scene2"):
        kinect = cv2.imread(str(DATA / f"silios-kinect/{folder}/2020511_kinect_hd_rgb.png"))
        path = DATA / f"silios-kinect/{folder}/2020511_multispectral_camera.png"
        mosaic = np.asarray(read_frame(path), np.float32).squeeze()
        h, w = (n // 3 * 3 for n in mosaic.shape)
        for channel, (row, column) in ((0, (2, 2)), (2, (0, 0))):
            band = mosaic[row:h:3, column:w:3]
            found.append(
                (f"cameras {folder} {channel}", band, kinect[..., channel].astype(np.float32))
            )
    pairs = []
    for name, first, second in found:
        try:
            known = register(
                [BandImage.of("a", first)], [BandImage.of("b", second)], reference_band="a"
            )
        except RegistrationRefused:
            continue
        if known.verdict.decision != "refuse":
            pairs.append((name, first, second, known.transforms["b"]))
    return pairs


def heat(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Return a picture of the same outlines in which tones are mixed anew from place to place."""

    def field(share: float) -> np.ndarray:
        sigma = share * max(picture.shape)
        coarse = rng.normal(size=(48, 48)).astype(np.float32)
        soft = cv2.GaussianBlur(coarse, (0, 0), 48 * share)
        values = cv2.resize(soft, picture.shape[::-1], interpolation=cv2.INTER_CUBIC)
        return values / max(values.std(), 1e-9) if sigma else values

    tone = cv2.GaussianBlur(picture, (0, 0), 2.0)
    tone = (tone - tone.min()) / np.ptp(tone)
    waves = [
        field(0.08) * np.cos(2 * np.pi * (f * tone + rng.uniform())) / f for f in (0.5, 1, 1.5)
    ]
    mixed = sum(waves)
    return (mixed / mixed.std() + 0.5 * field(0.15)).astype(np.float32)


def scene(name: str) -> str:
    """Return what a picture shows: pictures of one scene are no impostors of one another."""
    kind, *rest = name.split()
    if kind in ("kinect", "silios", "cameras"):
        return "vine"  # one view, with a chart before it or without
    if kind in ("rededge", "lenses"):
        return rest[0]
    return rest[0][:4] if kind == "tissue" else kind


def pair(rng: np.random.Generator, lenses: list, pictures: dict, *, same: bool = True):
    """Return (name, reference, target, true map or None, what of the target shows the object)."""
    if rng.uniform() < 0.5:
        names = list(pictures)
        name, *others = (names[k] for k in rng.permutation(len(names)))
        other = next(one for one in others if scene(one) != scene(name))
        first = pictures[name][0]
        second = heat(rng, first if same else pictures[other][0])
        between, kind, most = Affine.identity(), "heat", 1.5
        if not same:
            first, second = (
                part[: min(first.shape[0], second.shape[0]), : min(first.shape[1], second.shape[1])]
                for part in (first, second)
            )
    else:
        drawn = [lenses[k] for k in rng.permutation(len(lenses))]
        name, first, second, between = drawn[0]
        kind, most = name.split()[0], 5.0
        if not same:
            _, _, second, between = next(one for one in drawn if scene(one[0]) != scene(name))
    size = (int(rng.integers(180, 401)), int(rng.integers(140, 301)))
    h, w = first.shape
    ratio = min(0.95 * w / size[0], 0.95 * h / size[1], float(rng.uniform(1.2, most)))
    corner = rng.uniform(0, [w - 1 - ratio * size[0], h - 1 - ratio * size[1]])
    home = Affine(np.column_stack([ratio * np.eye(2), corner]))
    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(1.5))))
    other_size = (round(size[0] * scale), round(size[1] * scale))
    turn = rng.uniform(-180, 180) if rng.uniform() < 0.2 else rng.normal(0, 2)
    truth = view(rng, size, other_size, scale, turn=turn, shift=rng.normal(0, 0.05, 2))
    reference = sample(first, home, size)
    target = sample(second, Composed(truth.inverse, home, between), other_size)
    target = cv2.GaussianBlur(target, (0, 0), float(rng.uniform(0.3, 2.0)))
    for image in (reference, target):
        image += rng.normal(0, image.std() / rng.uniform(6, 30), image.shape).astype(np.float32)
    shown = sample(np.ones_like(second), Composed(truth.inverse, home, between), other_size) > 0.9
    return (
        kind if same else f"impostor, {kind}",
        reference,
        target,
        truth if same else None,
        shown,
        name,
    )


def tell(rows: list[dict]) -> dict[str, int]:
    """Print right maps, wrong maps and impostors by class; return the counts of the results file."""
    print(f"{'pairs':20s} {'n':>4s}  right: accept doubtful refuse  wrong: accept doubtful refuse")
    for name in [*sorted({r["name"] for r in rows}), "all"]:
        group = [r for r in rows if name in ("all", r["name"])]
        said = Counter(
            (r["true"] and r.get("error", 1e3) <= RIGHT_PX, r["decision"]) for r in group
        )
        cells = [
            said[right, one] for right in (True, False) for one in ("accept", "warn", "refuse")
        ]
        print(f"{name:20s} {len(group):4d} ", *(f"{n:8d}" for n in cells))
    pairs = [r for r in rows if r["true"]]
    said = Counter((r.get("error", 1e3) <= RIGHT_PX, r["decision"]) for r in pairs)
    impostors = [r["decision"] for r in rows if not r["true"]]
    return {
        f"unlike light, {len(pairs)} pairs: right, accepted": said[True, "accept"],
        "right, doubtful": said[True, "warn"],
        "wrong, accepted": said[False, "accept"],
        f"{len(impostors)} impostors: not refused": sum(d != "refuse" for d in impostors),
    }


def main() -> None:
    """Register pairs, or judge those of an earlier run again."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--impostors", type=int, default=200)
    parser.add_argument("--seed", type=int, default=51)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--again", type=Path)
    add_option(parser)
    arguments = parser.parse_args()
    if arguments.again:
        rows = json.loads(arguments.again.read_text(encoding="utf-8"))
        for row in rows:
            if row.get("numbers"):
                row |= judge_windows(row["numbers"]).to_dict()
        record(arguments.results, "verdict", tell(rows))
        return
    lenses, pictures, rows = lens_pairs(), real_bands(), []
    for same, count in ((True, arguments.pairs), (False, arguments.impostors)):
        for number in range(count):
            rng = np.random.default_rng([arguments.seed, int(same), number])
            name, reference, target, truth, shown, picture = pair(rng, lenses, pictures, same=same)
            rows.append(judged(name, reference, target, truth, shown, picture))
            if arguments.json:
                arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    record(arguments.results, "verdict", tell(rows))


if __name__ == "__main__":
    main()
