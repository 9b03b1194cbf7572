"""The course of a registration, pair by pair: python examples/figure_9_registration.py out.png"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from matplotlib.figure import Figure

import levkas
from levkas.registration import BandImage, Registration
from levkas.simulation import Preset

SMALL = Preset(scale=0.25, thin=True, charts=False, supersampling=1, fineness=2.0)


def register_simulated_pair() -> Registration:
    """Register green sensels of a colour camera to a filter camera, with every mutual match."""
    with TemporaryDirectory() as folder:
        list(levkas.simulate_campaign(Path(folder, "icon"), preset=SMALL, cameras=["d80"]))
        raw = Path(folder, "icon", "raw")
        reference = BandImage.of("550", tifffile.imread(raw / "lctf-vis/icon1/550nm_00.tif"))
        target = BandImage.of("G", tifffile.imread(raw / "d80/icon1/DSC_1000.tif")[::2, 1::2])
    options = {"reference_band": "550", "method": "mirhashemi2019", "matching": "mutual"}
    return levkas.register([reference], [target], **options)


def main(output: Path, found: Registration | None = None) -> Figure:
    found = found or register_simulated_pair()
    trace, (a, b) = found.trace, (found.matches.reference, found.matches.target)
    states = {"(a) start": np.ones(len(a), bool), "(b) after the cut at T1": trace.kept_at(0)}
    states |= {"(c) half-way": trace.kept_at(trace.rounds // 2), "(d) at T2": trace.kept_at(-1)}
    edges = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * trace.size - 0.5
    figure = Figure((8, 6.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, kept) in zip(panels.flat, states.items(), strict=True):
        fit = levkas.Polynomial.fit(b[kept], a[kept], order=3)
        mapped = (trace.scale if kept.all() else fit)(b[kept])
        fitted = fit(trace.scale.inverse(trace.frame))
        axes.fill(*edges.T, fill=False, edgecolor="black", label="reference")
        axes.fill(*trace.frame.T, fill=False, edgecolor="tab:red", label="target, scale alone")
        axes.fill(*fitted.T, fill=False, edgecolor="magenta", label="target, least squares")
        axes.plot(*np.stack([a[kept], mapped]).transpose(2, 0, 1), color="0.6", linewidth=0.6)
        axes.plot(*a[kept].T, ".", color="tab:red", markersize=3, label="reference points")
        axes.plot(*mapped.T, ".", color="tab:blue", markersize=3, label="target points")
        axes.set(title=f"{name}: {kept.sum()} pairs", aspect="equal")
    shared = np.sort(np.clip(fitted, 0, trace.size), axis=0)[1:3]  # by a target hardly turned
    (x, y), (u, v) = shared + 0.07 * np.ptp(shared, axis=0) * [[1], [-1]]
    axes.fill([x, u, u, x], [y, y, v, v], fill=False, edgecolor="darkcyan", label="final region")
    panels[0, 0].set(xlim=(-60, trace.size[0] + 60), ylim=(trace.size[1] + 50, -50))
    panels[1, 0].set(xlabel="x (reference px)", ylabel="y (reference px)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(output, dpi=90)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
