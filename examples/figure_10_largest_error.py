"""The largest error as pair by pair leaves: python examples/figure_10_largest_error.py out.png"""

import sys
from pathlib import Path

import numpy as np
from figure_9_registration import register_simulated_pair
from matplotlib.figure import Figure

from levkas.registration import Registration


def main(output: Path, found: Registration | None = None) -> Figure:
    trace = (found or register_simulated_pair()).trace
    cut = int((trace.scale_errors >= trace.reject).sum())
    rounds = np.arange(1, trace.rounds + 1)

    figure = Figure((7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0], [trace.scale_errors.max()], "s", color="tab:red", label="under scale alone")
    axes.plot(rounds, trace.largest, ".-", color="tab:blue", label="under the fit of each round")
    axes.text(trace.rounds, 1.06 * trace.reject, f"T1 = {trace.reject:.3g} px", ha="right")
    axes.text(0, 0.94 * trace.stop, f"T2 = {trace.stop:.3g} px", va="top")
    for threshold in (trace.reject, trace.stop):
        axes.axhline(threshold, color="0.5", linestyle="--", linewidth=1)
    axes.annotate(
        f"{cut} pairs leave at once", (0, trace.scale_errors.max()), (14, -4),
        textcoords="offset points",
    )  # fmt: skip
    axes.set(yscale="log", xlim=(-1, trace.rounds + 1))
    axes.set(xlabel="round (one pair leaves in each)", ylabel="largest error (reference px)")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper right", frameon=False)
    figure.savefig(output, dpi=100)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
