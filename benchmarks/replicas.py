"""Another painting by the same pattern, in the same place: never a layer that looks right.

    python benchmarks/replicas.py [--pairs 120] [--first 0]
    python benchmarks/replicas.py --campaigns 2 [--scale 0.2]

One panel imaged twice, and two panels by one pattern, through a stencil or by a free
hand, with strokes, cracks, holes and weave of their own, in visible light, infrared and X-rays. Thresholds were set on
other panels than are drawn here. `--campaigns` simulates campaigns of two icons each: one panel, one pose, one pattern
(halo, garments, folds, border, letters), other colours, strokes, gold and craquelure; every camera of either is registered
to the reference camera of both. Prints the verdict, the correlation of marks, and by class what was decided.
"""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from pairs import shoot, view
from scipy.spatial import cKDTree
from verdict_classes import judged

from levkas.building import build
from levkas.geometry.transforms import Affine, Composed
from levkas.quality.evaluation.native_layers import read_native_layer
from levkas.registration import RegistrationRefused, register
from levkas.simulation import campaigns

CAMERAS = ("d80", "lctf-nir", "msbs", "v10")
NAMES = ("icon1", "icon2")
WIDTH, HEIGHT = 1500, 1125
SIZE = (620, 465)
KINDS = ("same", "stencil", "freehand")
LIGHTS = ("visible", "visible", "infrared", "xray")


# --- panels by one pattern


def grain(rng: np.random.Generator, sigma: tuple[float, float]) -> np.ndarray:
    """Return noise of correlation lengths `sigma`, px down and across, of unit variance."""
    n = max(1, int(min(sigma) / 2))
    noise = rng.standard_normal((HEIGHT // n, WIDTH // n), np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), sigmaX=sigma[1] / n, sigmaY=sigma[0] / n)
    soft = cv2.resize(soft, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return soft / soft.std()


def wobbled(image: np.ndarray, rng: np.random.Generator, amount: float, length: float, how: int):
    """Return an image whose px are displaced by smooth noise of `amount` px."""
    down, across = ((amount * grain(rng, (length, length))).astype(np.float32) for _ in "yx")
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    return cv2.remap(image, x + across, y + down, how, borderMode=cv2.BORDER_REFLECT)


def cells(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the nearest of `count` places, and by how much nearer it is than the next, px."""
    rows, columns = np.mgrid[0:HEIGHT:2, 0:WIDTH:2]
    places = np.stack([rows.ravel(), columns.ravel()], 1)
    distance, nearest = cKDTree(rng.uniform(0, 1, (count, 2)) * (HEIGHT, WIDTH)).query(places, k=2)
    edge = (distance[:, 1] - distance[:, 0]).reshape(rows.shape).astype(np.float32)
    number = nearest[:, 0].reshape(rows.shape).astype(np.uint8)
    size = (WIDTH, HEIGHT)
    return cv2.resize(number, size, interpolation=cv2.INTER_NEAREST), cv2.resize(edge, size)


class Pattern:
    """Drawing that panels share: fields, lines of two to seven px, letters; and the tones of the fields."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = int(rng.integers(25, 120))
        self.fields = wobbled(cells(rng, count)[0], rng, 40, 25, cv2.INTER_NEAREST)
        self.tones = rng.uniform(0.1, 0.75, count)
        self.ink = np.zeros((HEIGHT, WIDTH), np.float32)
        for _ in range(int(rng.integers(15, 60))):
            start = rng.uniform(0, 1, 2) * (WIDTH, HEIGHT)
            a, b, c, d = start + np.cumsum(rng.normal(0, rng.choice((60, 200)), (4, 2)), 0)
            t = np.linspace(0, 1, 60)[:, None]
            curve = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
            self._draw(curve, float(rng.uniform(0.3, 1)), int(rng.integers(2, 8)))
        for _ in range(3 * int(rng.integers(0, 60))):
            start = rng.uniform(0.05, 0.95, 2) * (WIDTH, HEIGHT)
            self._draw(start + rng.uniform(-12, 12, (3, 2)), 1.0, int(rng.integers(2, 5)))

    def _draw(self, points: np.ndarray, value: float, width: int) -> None:
        line = np.round(points * 16).astype(np.int32)
        cv2.polylines(self.ink, [line], False, value, width, cv2.LINE_AA, 4)


class Panel:
    """One panel by a pattern: `visible`, `infrared` and `xray`, (h, w), what it reflects or lets through.

    `freehand` px of the panel is how far its drawing is off the pattern; a stencil is not.
    """

    def __init__(self, pattern: Pattern, rng: np.random.Generator, freehand: float = 0.0) -> None:
        fields, ink = pattern.fields, pattern.ink
        if freehand:
            hand = int(rng.integers(1 << 30))
            fields, ink = (
                wobbled(image, np.random.default_rng(hand), freehand, 40, how)
                for image, how in ((fields, cv2.INTER_NEAREST), (ink, cv2.INTER_LINEAR))
            )
        n = len(pattern.tones)
        tones = np.clip(pattern.tones * (1 + rng.uniform(0, 0.3) * rng.normal(0, 1, n)), 0.05, 0.85)
        infrared = np.clip(0.5 + 0.2 * rng.normal(0, 1, n), 0.1, 0.85)
        xray = np.clip(0.4 + 0.2 * rng.normal(0, 1, n), 0.1, 0.9)
        strokes = sum(a * grain(rng, s) for a, s in ((0.5, (1, 2.5)), (0.7, (2, 6)), (0.7, (4, 9))))
        strokes = rng.uniform(0.01, 0.06) * strokes
        weave = 0.03 * (grain(rng, (1.5, 12)) + grain(rng, (12, 1.5)))
        edge = wobbled(cells(rng, int(rng.integers(300, 3000)))[1], rng, 6, 6, cv2.INTER_LINEAR)
        cracks = rng.uniform(0.1, 0.5) * np.exp(-np.square(edge / rng.uniform(1, 2.5)))
        cracks = cracks * (rng.uniform() < 0.85)
        holes = np.zeros((HEIGHT, WIDTH), np.float32)
        for x, y in (rng.uniform(0, 1, (int(rng.integers(0, 250)), 2)) * (WIDTH, HEIGHT)).astype(
            int
        ):
            cv2.circle(holes, (int(x), int(y)), int(rng.integers(1, 7)), 1.0, -1, cv2.LINE_AA)

        def painted(values: np.ndarray) -> np.ndarray:
            return cv2.GaussianBlur(values[fields].astype(np.float32), (0, 0), 1.0)

        age = [
            (1 - share * cracks) * (1 - depth * holes)
            for share, depth in ((1, 0.5), (0.5, 0.3), (0.4, 0.5))
        ]
        self.visible = painted(tones) * (1 - 0.6 * ink) * (1 + strokes) * age[0]
        self.infrared = painted(infrared) * (1 - 0.3 * ink) * (1 + 0.4 * strokes) * age[1]
        self.xray = (painted(xray) + 0.1 * ink) * (1 + 0.5 * strokes + 0.5 * weave) * age[2]


def panels(seed: int):
    """Return (name, reference, target, true map or None): one panel imaged twice, or two by one pattern."""
    rng = np.random.default_rng([17, seed])
    kind, light = KINDS[seed % 3], LIGHTS[seed // 3 % 4]
    pattern = Pattern(rng)
    one = Panel(pattern, rng)
    freehand = rng.uniform(0.8, 3.0) if kind == "freehand" else 0.0
    other = one if kind == "same" else Panel(pattern, rng, freehand)
    scale = float(np.exp(rng.uniform(np.log(0.6), np.log(1.7))))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    truth = view(rng, SIZE, size, scale, turn=rng.normal(0, 1.5), shift=rng.normal(0, 0.02, 2))
    spacing = float(rng.uniform(1.2, 2.2))
    corner = (np.array([WIDTH, HEIGHT]) - 1) / 2 - spacing * (np.array(SIZE) - 1) / 2
    home = Affine(np.column_stack([spacing * np.eye(2), corner]))
    snr = float(np.exp(rng.uniform(np.log(15), np.log(90))))
    reference = shoot(one.visible.astype(np.float32), home, SIZE, rng, snr=rng.uniform(30, 80))
    layer = getattr(other, light).astype(np.float32)
    there = Composed(truth.inverse, home)
    target = shoot(layer, there, size, rng, snr=snr, blur=rng.uniform(0, 0.8))
    return f"{kind}, {light}", reference, target, truth if kind == "same" else None


# --- campaigns and pairs


class Replicas(campaigns.SimulatedSession):
    """Every object on the first one's panel, laid as it was, painted by its pattern."""

    saints = 1

    def __init__(self, *arguments):
        super().__init__(*arguments)
        for name in self.names[1:]:
            self.panels[name] = self.panels[self.names[0]]
            self.views[name] = self.views[self.names[0]]

    def paint(self, name, index, library, photograph):
        """Paint as many saints on each."""
        return super().paint(name, self.saints - 1, library, photograph)


def simulated(folder: Path, seed: int, scale: float) -> Path:
    """Simulate and build a campaign of copies; return its database."""
    Replicas.saints = 1 + seed % 3
    plain, campaigns.SimulatedSession = campaigns.SimulatedSession, Replicas
    try:
        for _ in campaigns.simulate_campaign(
            folder, seed=seed, preset="small", scale=scale, objects=2
        ):
            pass
    finally:
        campaigns.SimulatedSession = plain
    with (folder / "campaign.toml").open("a") as keys:
        keys.write("\n[database]\nnative = true\n")
    for _ in build(folder):
        pass
    return folder / "database"


def describe_marks(numbers: dict) -> str:
    """Return the correlation of marks of each sensor."""
    found = [sensor["verification"].get("marks") for sensor in numbers.values()]
    return "; ".join(
        f"marks {m['correlation']:.2f}, at most {m['at_most']:.2f}, held {m['held']}"
        if m
        else "no marks"
        for m in found
    )


def of_campaigns(count: int, scale: float) -> None:
    """Print a line a sensor, and what was decided of right pairs and of copies."""
    said = {True: Counter(), False: Counter()}
    for seed in range(1, count + 1):
        with tempfile.TemporaryDirectory() as folder:
            database = simulated(Path(folder) / "campaign", seed, scale)
            images = {
                (name, camera): read_native_layer(database, name, camera, "").images()
                for name in NAMES
                for camera in (*CAMERAS, "lctf-vis")
            }
        for (name, camera), target in images.items():
            for ours in NAMES:
                same = name == ours
                if camera == "lctf-vis" and same:
                    continue
                line = f"seed {seed} {'same' if same else 'copy'} {camera}"
                try:
                    found = register(images[ours, "lctf-vis"], target, reference_band="550 nm")
                except RegistrationRefused as refused:
                    said[same]["refuse"] += 1
                    print(line, "refused", refused)
                    continue
                said[same][found.verdict.decision] += 1
                marks = describe_marks(found.verdict.numbers)
                print(line, found.verdict.decision, marks, flush=True)
    print("same painting:", dict(said[True]), " copies:", dict(said[False]))


def of_pairs(first: int, count: int) -> None:
    """Print a line a pair, and a table by class: accepted, doubtful, refused, and refused or doubted by marks."""
    said: dict[str, Counter] = {}
    for seed in range(first, first + count):
        name, reference, target, truth = panels(seed)
        row = judged(name, reference, target, truth, np.ones(target.shape, bool))
        group = said.setdefault(name, Counter())
        group[row["decision"]] += 1
        group["by marks"] += any("fine marks between them" in reason for reason in row["reasons"])
        marks = describe_marks(row.get("numbers") or {})
        error = f"{row['error']:.2f} px" if "error" in row else ""
        print(f"{seed:4d} {name:20s} {row['decision']:7s} {error} {marks}", flush=True)
    print(f"{'pairs':20s} accepted doubtful refused  by marks")
    for name, group in sorted(said.items()):
        print(f"{name:20s}", *(f"{group[k]:8d}" for k in ("accept", "warn", "refuse", "by marks")))


def main() -> None:
    """Register pairs of panels, or campaigns of icons."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=120)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--campaigns", type=int, default=0)
    parser.add_argument("--scale", type=float, default=0.2)
    arguments = parser.parse_args()
    if arguments.campaigns:
        of_campaigns(arguments.campaigns, arguments.scale)
    else:
        of_pairs(arguments.first, arguments.pairs)


if __name__ == "__main__":
    main()
