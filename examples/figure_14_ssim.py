"""Methods by SSIM, and the maps of one layer: python examples/figure_14_ssim.py FOLDER out.png

FOLDER is what `levkas methods CAMPAIGN -o FOLDER` wrote.
"""

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

INKS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#000000", "#56b4e9")
MAPS = ("levkas", "mirhashemi2019", "gdbicp-radial", "surf-projective")


def read_scores(folder: Path) -> tuple[list[str], dict[str, np.ndarray], list[dict]]:
    """Return layers, method → SSIM of every layer (NaN where it failed), and all rows."""
    rows = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))["comparison"]
    layers = list(dict.fromkeys(f"{r['object']} {r['layer']}" for r in rows))
    scores = {r["method"]: np.full(len(layers), np.nan) for r in rows}
    for r in rows:
        if r.get("ssim") is not None:
            scores[r["method"]][layers.index(f"{r['object']} {r['layer']}")] = r["ssim"]
    return layers, scores, rows


def main(folder: Path, output: Path) -> Figure:
    layers, scores, rows = read_scores(folder)
    figure = Figure((9, 6.4), layout="constrained")
    whole = figure.subfigures(2, 1, height_ratios=(1.25, 1))
    axes = whole[0].subplots()
    for place, (method, values) in enumerate(scores.items()):
        ink, mark = INKS[place % len(INKS)], "osD^vP*"[place % 7]
        shift = (place - (len(scores) - 1) / 2) * 0.06
        axes.plot(np.arange(len(layers)) + shift, values, mark, color=ink, ms=6, label=method)
    axes.set_xticks(range(len(layers)), layers)
    axes.set(ylabel="SSIM to the reference camera")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)

    name = rows[0]["layer"]
    shown = [r for m in MAPS for r in rows if (r["method"], r["layer"]) == (m, name) and r["map"]]
    panels = whole[1].subplots(1, len(MAPS))
    for panel in panels:
        panel.axis("off")
    for panel, row in zip(panels, shown, strict=False):
        panel.imshow(imread(folder / row["map"]), cmap="gray", vmin=0, vmax=1)
        panel.set_title(f"{row['method']}\n{row['ssim']:.3f}", fontsize=9)
    figure.savefig(output, dpi=100)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
