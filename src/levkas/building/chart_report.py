"""What was measured of charts, for people, programs and a page."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from levkas.core.problems import Problem
from levkas.quality.targets.measuring import ChartMeasure


@dataclass(frozen=True)
class ChartReport:
    """All charts of a run: what was measured, and what was refused."""

    measures: list[ChartMeasure] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether a chart was measured, and none refused."""
        return bool(self.measures) and not self.problems

    @property
    def text(self) -> str:
        """What a person wants to know."""
        return "\n".join(line for m in self.measures for line in _lines(m))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of `chart --json`."""
        return {"charts": [m.to_dict() for m in self.measures]}

    def page(self, title: str) -> str:
        """Return a report page as HTML."""
        from levkas import __version__
        from levkas.pages.camera import CameraReport, render_camera
        from levkas.pages.charts import describe_chart

        return render_camera(
            CameraReport(
                title=title,
                subtitle="Charts: signal, noise and colour",
                charts=[describe_chart(m) for m in self.measures],
                problems=[{"code": p.code, "text": str(p)} for p in self.problems],
                footer=f"Levkas {__version__}. Places are in native pixels.",
            )
        )


def _lines(measure: ChartMeasure) -> list[str]:
    greys = list(measure.chart.greys)
    white, black = (measure.snr_db[g] for g in (greys[0], greys[-1]))
    agreement = min(s.located.agreement for s in measure.sightings)
    lines = [
        f"{measure.name}: {measure.chart.name} found, rank correlation {agreement:.3f}",
        f"  SNR of the white patch {_span(white)}, of the black one {_span(black)} (dB of Eq. 1)",
    ]
    blurred = [
        b.label for b, p in zip(measure.bands, measure.preblurs, strict=True) if p and p.found
    ]
    if blurred:
        lines.append(
            f"  noise of neighbours is alike in {', '.join(blurred)} (a camera that blurs, or demosaicing): SNR corrected"
        )
    lines += [
        f"  {row.name}: {row.value:.2f} {row.unit} (FADGI {row.fadgi}, ISO 19264-1 {row.iso}; indicators only)"
        for row in measure.rows
    ]
    return lines + [f"  note: {note}" for note in measure.notes]


def _span(values: np.ndarray) -> str:
    good = values[np.isfinite(values)]
    return f"{good.min():.1f} to {good.max():.1f}" if good.size else "not known"
