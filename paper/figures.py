"""Figures of paper.md: python paper/figures.py [DATABASE]

comparison.png is drawn from benchmarks/results.json. panel.png needs the database of the first tutorial
(docs/tutorials/first_database.md), panel/database, built with `native = true` under `[database]` in its campaign.toml.
"""

import hashlib
import sys
from pathlib import Path

import matplotlib
import numpy as np

import levkas

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "benchmarks"))

from results import Results, load  # noqa: E402

STYLE = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
#: Colours of Okabe and Ito, and marks, which differ without colour too.
CAMERAS = dict(zip(("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000"), "osD^v", strict=True))
OBJECT, CAMERA_OF_SIGMA = "panel", "infrared"
CAMERAS_SHOWN = ("photo", "infrared", "xray")


def draw_comparison(results: Results) -> plt.Figure:
    """Draw the mean error of every method and camera, px; a cross at the right for a failure."""
    figures = [f for f in results.of("comparison") if f.aspect != "CPU"]
    methods = list(dict.fromkeys(f.what for f in figures))
    cameras = list(dict.fromkeys(f.aspect for f in figures))
    most = 2 * max(f.value for f in figures if f.value is not None)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.4, 2.9), layout="constrained")
        for camera, (colour, mark) in zip(cameras, CAMERAS.items(), strict=True):
            here = [f for f in figures if f.aspect == camera]
            rows = [methods.index(f.what) for f in here]
            known = [f.value if f.value is not None else np.nan for f in here]
            axes.plot(known, rows, mark, color=colour, ms=5, alpha=0.8, label=camera)
            failed = [row for f, row in zip(here, rows, strict=True) if f.value is None]
            axes.plot([most] * len(failed), failed, "x", color=colour, ms=6)
        axes.set(
            xscale="log", xlabel="mean error, px of the reference band", xlim=(0.004, 1.3 * most)
        )
        axes.set_yticks(range(len(methods)), methods)
        axes.invert_yaxis()
        axes.grid(axis="x", which="major", color="0.85")
        axes.set_axisbelow(True)
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def draw_panel(database: Path) -> plt.Figure:
    """Draw strips of three cameras as recorded and as registered, and the uncertainty of the position."""
    found = levkas.open(database)[OBJECT]
    registered = [shown(np.asarray(found[camera])) for camera in CAMERAS_SHOWN]
    native = database / "objects" / OBJECT / "native"
    recorded = [
        shown(levkas.read_stiff(native / f"{OBJECT}_{c}.tif", silent=True)[0])
        for c in CAMERAS_SHOWN
    ]
    size = registered[0].shape[:2]
    sigma = np.asarray(found.position_sigma(CAMERA_OF_SIGMA))
    with plt.rc_context(STYLE):
        figure, (before, after, right) = plt.subplots(
            1, 3, figsize=(6.3, 2.9), layout="constrained"
        )
        before.imshow(strips([stretched(picture, size) for picture in recorded]))
        after.imshow(strips(registered))
        drawn = right.imshow(sigma, cmap="viridis", norm=LogNorm())
        figure.colorbar(drawn, ax=right, shrink=0.8, label="px")
        for axes, title in (
            (before, "(a) as recorded"),
            (after, "(b) registered"),
            (right, "(c) uncertainty"),
        ):
            axes.set_title(title, fontsize=8)
            axes.axis("off")
    return figure


def shown(values: np.ndarray) -> np.ndarray:
    """Return a picture (h, w, 3), 0 to 1, of counts (h, w, 1 or 3)."""
    low, high = np.nanpercentile(values, (0.5, 99.5))
    return np.repeat(np.clip((values - low) / (high - low), 0, 1), 3 // values.shape[2], axis=2)


def stretched(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a picture at another size (height, width), by the nearest pixel."""
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int)
        for new, old in zip(size, picture.shape, strict=False)
    )
    return picture[np.ix_(rows, columns)]


def strips(pictures: list[np.ndarray], count: int = 9) -> np.ndarray:
    """Return pictures of one size in `count` upright strips, in turn."""
    width = pictures[0].shape[1]
    which = np.arange(width) * count // width % len(pictures)
    return np.choose(which[None, :, None], [np.nan_to_num(p) for p in pictures])


def digest(results: Results) -> str:
    """Return the SHA-256 of the values that `draw_comparison` draws; it is kept in comparison.png."""
    values = [(f.what, f.aspect, f.value) for f in results.of("comparison") if f.aspect != "CPU"]
    return hashlib.sha256(repr(values).encode()).hexdigest()


def save(figure: plt.Figure, name: str, dpi: int, description: str = "") -> None:
    """Write a figure beside paper.md, without date or version in it."""
    figure.savefig(HERE / name, dpi=dpi, metadata={"Software": None, "Description": description})
    plt.close(figure)


if __name__ == "__main__":
    save(draw_comparison(load()), "comparison.png", 200, digest(load()))
    if len(sys.argv) > 1:
        save(draw_panel(Path(sys.argv[1])), "panel.png", 150)
