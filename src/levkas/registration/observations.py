"""What the windows of one sensor saw, in a form that outlives the pictures.

Several captures by one camera share its lens and, where nothing was moved, its pose. To adjust their
maps together no picture is needed: where each window lies in the target, how well that is known, and
how the bands lie to one another are enough.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Transform, from_dict
from levkas.registration.chromatic import Chromatic
from levkas.registration.model_selection import Terms
from levkas.registration.models import Observations

if TYPE_CHECKING:
    from levkas.registration.sensors import Sensor

_SEEN = ("points", "target", "jacobian", "information")


@dataclass(frozen=True)
class Sighting:
    """One sensor of one capture as its own registration left it.

    Parameters
    ----------
    sensor : str
    labels : tuple of str
        Its bands, in the order of `chromatic`.
    base : Transform
        Reference px → native px, before what sets the bands apart.
    chromatic : Chromatic
    held_out : float, reference px
        How far `base` is off in blocks that it was not fitted to; 0 where nothing was fitted.
    seen : Observations or None
        What `base` was fitted to; None for the reference's own sensor.
    terms : Terms or None
        On which it was fitted.
    """

    sensor: str
    labels: tuple[str, ...]
    base: Transform
    chromatic: Chromatic
    held_out: float = 0.0
    seen: Observations | None = None
    terms: Terms | None = None

    @classmethod
    def of(cls, sensor: Sensor) -> Sighting:
        """Return what is worth keeping of a registered sensor."""
        rung, labels = sensor.rung, tuple(sensor.sigma)
        if rung is None or rung.terms is None:
            return cls(sensor.name, labels, Affine.identity(), sensor.chromatic)
        held_out = float(rung.scores[rung.name])
        return cls(
            sensor.name, labels, sensor.base, sensor.chromatic, held_out, rung.observations,
            rung.terms,
        )  # fmt: skip

    def enlarged(self, grow: Affine) -> Sighting:
        """Return the sighting of larger native px: `grow` maps those of now to them."""
        if self.seen is None:
            return self
        jacobian = np.einsum("ab,nbc->nac", grow.matrix[:, :2], self.seen.jacobian)
        points, known = self.seen.points, self.seen.information
        seen = Observations(points, grow(self.seen.target), jacobian, known)
        return Sighting(
            self.sensor, self.labels, Composed(self.base, grow), self.chromatic, self.held_out,
            seen, self.terms,
        )  # fmt: skip

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return arrays that say all of it."""
        c = self.chromatic
        told = {
            "sensor": self.sensor,
            "labels": self.labels,
            "base": self.base.to_dict(),
            "kind": c.kind,
            "spread": c.spread,
            "held_out": self.held_out,
            "terms": None if self.terms is None else asdict(self.terms),
        }
        arrays = {"told": np.array(json.dumps(told)), "centre": c.centre, "amounts": c.amounts}
        if c.variances is not None:
            arrays["variances"] = c.variances
        if self.seen is not None:
            arrays |= {name: getattr(self.seen, name) for name in _SEEN}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Sighting:
        """Read what `to_arrays` gave; raises KeyError or ValueError on anything else."""
        told = json.loads(str(arrays["told"]))
        chromatic = Chromatic(
            told["kind"], arrays["centre"], told["spread"], arrays["amounts"],
            arrays.get("variances"),
        )  # fmt: skip
        seen = Observations(*(arrays[name] for name in _SEEN)) if "points" in arrays else None
        terms = None if told["terms"] is None else Terms(**told["terms"])
        return cls(
            told["sensor"], tuple(told["labels"]), from_dict(told["base"]), chromatic,
            told["held_out"], seen, terms,
        )  # fmt: skip
