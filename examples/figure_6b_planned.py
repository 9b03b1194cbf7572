"""How evenly two feathered lamps light the panel: python examples/figure_6b_planned.py out.png"""

import sys
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from levkas.planning import illuminate, load_setup, sample_surface

BENCH = Path(__file__).parent / "plan"


def main(output: Path) -> Figure:
    setup = load_setup(BENCH)
    thing = setup.object
    wide = thing.model_copy(update={"size_mm": (840.0, 640.0), "recess_mm": 0.0})
    surface = sample_surface(wide, 121)
    light = illuminate(setup.lighting("proposed").lamps, surface.points, surface.normals)
    width, height = thing.size_mm
    across, down = abs(surface.x) <= width / 2, abs(surface.y) <= height / 2
    inner = light[down][:, across]
    share = 100 * light / inner.max()

    figure = Figure((9.6, 4.1), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    shown = left.contourf(surface.x, surface.y, share, 24, cmap="magma")
    lines = left.contour(surface.x, surface.y, share, [70, 75, 80, 85, 90, 95, 100], colors="white")
    left.clabel(lines, fmt="%g %%", fontsize=8)
    outline = Rectangle((-width / 2, -height / 2), width, height, fill=False, color="lime", lw=2)
    left.add_patch(outline)
    left.axhline(0, color="red", lw=1)
    left.axvline(0, color="red", lw=1, ls="--")
    left.invert_yaxis()
    left.set(aspect="equal", xlabel="mm", ylabel="mm")
    lost = 1 - inner.min() / inner.max()
    left.set_title(f"in the frame the light drops by {100 * lost:.1f} %", fontsize=10)
    figure.colorbar(shown, ax=left, label="% of the greatest in the frame", shrink=0.9)

    row, column = light.shape[0] // 2, light.shape[1] // 2
    right.plot(surface.x, share[row], color="red", label="along the width")
    right.plot(surface.y, share[:, column], "--", color="red", label="along the height")
    right.axvspan(-width / 2, width / 2, color="lime", alpha=0.15, lw=0)
    right.set(xlabel="mm from the middle", ylabel="%")
    right.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False, fontsize=9)
    figure.savefig(output, dpi=90)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
