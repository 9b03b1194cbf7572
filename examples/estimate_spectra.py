"""Spectra of held-out paintings from a colour camera: python examples/estimate_spectra.py DATABASE out.png"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

from levkas.estimation.experiment import run_experiment
from levkas.estimation.plan import ExperimentPlan


def main(database: Path, output: Path) -> Figure:
    plan = ExperimentPlan(database, methods=("wiener", "matern"))
    report = list(run_experiment(plan))[-1].report
    figure = Figure((7.4, 3.6), layout="constrained")
    for axes, source in zip(
        figure.subplots(1, len(report.sources), squeeze=False)[0], report.sources, strict=True
    ):
        for score in source.ranked:
            axes.plot(report.wavelengths, score.by_band(), label=score.method)
        axes.axhline(
            source.ceiling or 0, color="grey", linestyle=":", label="noise of the reference"
        )
        axes.set(
            title=f"from {source.name}", xlabel="wavelength (nm)", ylabel="RMSE, held-out paintings"
        )
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False)
    figure.savefig(output, dpi=100)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
