"""The bench to scale, bright and dark field of a bent panel: python examples/figure_5b_bench.py out.png"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from levkas.planning import load_setup, plan_light

BENCH = Path(__file__).parent / "plan"


def wedge(axes, low, high, reach, label, **look):
    """Angles from the normal, which points up."""
    axes.add_patch(Wedge((0, 0), reach, 90 - high, 90 - low, linewidth=0, label=label, **look))


def view(axes, setup, plan, axis, name):
    field = plan.fields[name]
    reach = 2000.0
    wedge(axes, *field.facets, reach, "reached by facets", color="#f3e7c6")
    wedge(axes, *field.mirror, reach, "bright field of the panel", color="#e0bd78")
    if field.walls:
        low, high = field.walls
        for sign in (1, -1):
            ends = sorted((sign * low, sign * min(high, 90)))
            wedge(axes, *ends, reach, "walls of the recess", color="#c0392b", alpha=0.13)
    for lamp in plan.lighting.lamps:
        target = lamp.place - lamp.axis * lamp.place[2] / lamp.axis[2]
        ends = np.stack([lamp.place, target])[:, [axis, 2]]
        axes.plot(*ends.T, color="#d08a00", linewidth=1.2)
        axes.plot(*ends[0], "o", color="#d08a00", markersize=9, label="lamp")
    width = setup.object.size_mm[axis]
    axes.add_patch(Rectangle((-width / 2, -45), width, 45, color="#333333"))
    eye = next(iter(setup.cameras.values())).place
    axes.plot(eye[axis], eye[2], "s", color="black", markersize=10)
    axes.annotate("camera", (eye[axis], eye[2]), (12, -4), textcoords="offset points")
    axes.set(aspect="equal", xlim=(-2150, 2150), ylim=(-160, 2150), xlabel="mm")
    axes.set_title(f"along the {name}: {field.mirror[1]:.0f}°, with facets {field.facets[1]:.0f}°")
    axes.spines[["top", "right", "left"]].set_visible(False)


def main(output: Path) -> Figure:
    setup = load_setup(BENCH)
    plan = plan_light(setup, "proposed")
    figure = Figure((10, 3.6), layout="constrained")
    above, beside = figure.subplots(1, 2)
    view(above, setup, plan, 0, "width")
    view(beside, setup, plan, 1, "height")
    handles = dict(zip(*reversed(above.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(output, dpi=90)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
