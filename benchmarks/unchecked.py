"""Whether sigma holds where nothing could be checked: smoothly bent pairs of which a part shows nothing.

    python benchmarks/unchecked.py [--pairs 40]

A surface is seen twice through a perspective, a lens and a bend as a warped panel makes it; of the second
picture a part, a quarter to two thirds, has lost its detail. Of every pair: the share of the errors that lie within
the circle that should hold nine of ten, and error and sigma of an axis, where windows confirm the map and where
it only reaches over; what was decided.
"""

import argparse
from collections import Counter

import cv2
import numpy as np
from pairs import Studio, frame, shoot, view

from levkas.geometry.transforms import Composed, Polynomial
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.uncertainty import NINE_OF_TEN

SIZE = (400, 300)
BEND_PX = 6.0


def bent(rng: np.random.Generator) -> Polynomial:
    """Return reference px → reference px bent by up to `BEND_PX` at the rim, a random cubic."""
    x, y = np.meshgrid(np.linspace(0, SIZE[0] - 1, 21), np.linspace(0, SIZE[1] - 1, 17))
    points = np.stack([x.ravel(), y.ravel()], 1)
    u, v = (2 * points / np.array(SIZE) - 1).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], 1)
    field = terms @ rng.normal(0, 1, (terms.shape[1], 2))
    field *= rng.uniform(0, BEND_PX) / np.abs(field).max()
    return Polynomial.fit(points, points + field, order=3)


def pair(studio: Studio, rng: np.random.Generator):
    """Return (reference, target, true map, what of the reference's frame lost its detail)."""
    surface = studio.pick(rng, 1)[0]
    kind = ("visible", "inverted")[rng.integers(2)]
    scale = float(rng.uniform(0.8, 1.5))
    other = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    truth = Composed(
        bent(rng),
        view(rng, SIZE, other, scale, turn=rng.normal(0, 1.5), shift=rng.normal(0, 0.01, 2)),
    )
    home = frame(SIZE, surface)
    reference = shoot(surface.layer("visible"), home, SIZE, rng, snr=60)
    target = shoot(surface.layer(kind), Composed(truth.inverse, home), other, rng, snr=60)
    blank = cv2.GaussianBlur(target, (0, 0), 30.0)
    blank += rng.normal(0, 0.006, blank.shape).astype(np.float32)
    from_, part = rng.integers(4), rng.uniform(0.25, 0.67)
    rows, columns = np.mgrid[: other[1], : other[0]] / np.array(other[::-1])[:, None, None]
    lost = (rows, columns, 1 - rows, 1 - columns)[from_] > 1 - part
    return reference, np.where(lost, blank, target), truth, lost


def main() -> None:
    """Print a line a pair, and the shares over all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=40)
    number = parser.parse_args().pairs
    studio, rows, said = Studio(1), [], Counter()
    x, y = np.meshgrid(np.linspace(8, SIZE[0] - 9, 33), np.linspace(8, SIZE[1] - 9, 25))
    points = np.stack([x.ravel(), y.ravel()], 1)
    for k in range(number):
        reference, target, truth, lost = pair(studio, np.random.default_rng([20, k]))
        bands = [[BandImage.of("grey", picture)] for picture in (reference, target)]
        try:
            found = register(*bands, reference_band="grey")
        except RegistrationRefused as refused:
            said["refuse"] += 1
            print(k, "refused", refused)
            continue
        said[found.verdict.decision] += 1
        places = truth(points)
        seen = np.all((places >= 0) & (places <= np.array(target.shape[::-1]) - 1), 1)
        error = np.linalg.norm(truth.inverse(found.transforms["grey"](points)) - points, axis=1)
        sigma = found.sigma["grey"](points)
        column, row = np.rint(np.where(seen[:, None], places, 0)).astype(int).T
        bare = lost[row, column]
        numbers = found.verdict.numbers["sensor"]
        line = [k, found.verdict.decision, round(numbers["checked"], 2)]
        for part in (seen & ~bare, seen & bare):
            held = error[part] <= NINE_OF_TEN * sigma[part]
            rms = float(np.sqrt((error[part] ** 2).mean() / 2))
            line += [
                round(float(held.mean()), 2),
                round(rms, 3),
                round(float(sigma[part].mean()), 3),
            ]
        rows.append([line[3], line[6], line[4], line[7], line[5], line[8]])
        print(*line, flush=True)
    held = np.mean(rows, 0)
    print(f"held where detail was {held[0]:.2f}, where it was lost {held[1]:.2f}; {dict(said)}")
    print(f"pairs of which at least 0.85 is held: {np.mean(np.array(rows)[:, :2] >= 0.85, 0)}")


if __name__ == "__main__":
    main()
