"""What the registration of one capture alone came to, kept until others of its camera are known."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.registration.joint import SensorObservations
from levkas.registration.record import Matches

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.registration import Registration

_COLUMNS = tuple(column.name for column in fields(Matches))
_WORDS = ("state", "reason")


@dataclass(frozen=True)
class Measured:
    """A capture registered by itself.

    Parameters
    ----------
    record : dict
        Of registration/CAMERA.json.
    matches : dict of sensor to Matches
        As tables are written of them: the first sensor's under "".
    observations : tuple of SensorObservations
        Empty where it was refused.
    problems : tuple of Problem
        Why it was refused.
    """

    record: dict[str, Any]
    matches: dict[str, Matches] = field(default_factory=dict)
    observations: tuple[SensorObservations, ...] = ()
    problems: tuple[Problem, ...] = ()

    @classmethod
    def of(
        cls,
        record: dict[str, Any],
        registration: Registration | None,
        problems: tuple[Problem, ...],
    ) -> Measured:
        """Return what is worth keeping of a registration; None where there was none at all."""
        if registration is None:
            return cls(record, problems=problems)
        matches = {"": registration.matches, **registration.others}
        observations = () if problems else registration.observations
        return cls(record, matches, observations, problems)

    def to_bytes(self) -> bytes:
        """Return all of it as one file of arrays."""
        arrays: dict[str, np.ndarray] = {}
        for k, pairs in enumerate(self.matches.values()):
            for column in _COLUMNS:
                values = getattr(pairs, column)
                arrays[f"matches {k} {column}"] = (
                    values.astype(str) if column in _WORDS else np.asarray(values)
                )
        for k, sensor in enumerate(self.observations):
            arrays |= {f"sensor {k} {n}": a for n, a in sensor.to_arrays().items()}
        told = {
            "record": self.record,
            "sensors": list(self.matches),
            "observations": len(self.observations),
            "problems": [problem.to_dict() for problem in self.problems],
        }
        arrays["told"] = np.array(json.dumps(told))
        packed = io.BytesIO()
        np.savez_compressed(packed, allow_pickle=False, **arrays)
        return packed.getvalue()

    @classmethod
    def read(cls, path: Path) -> Measured:
        """Read what `to_bytes` gave; raises OSError, KeyError or ValueError on anything else."""
        with np.load(path, allow_pickle=False) as packed:
            arrays = dict(packed)
        told = json.loads(str(arrays["told"]))
        matches = {
            sensor: _matches(_under(arrays, f"matches {k} "))
            for k, sensor in enumerate(told["sensors"])
        }
        observations = tuple(
            SensorObservations.from_arrays(_under(arrays, f"sensor {k} "))
            for k in range(told["observations"])
        )
        problems = tuple(Problem(**problem) for problem in told["problems"])
        return cls(told["record"], matches, observations, problems)


def _under(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {k.removeprefix(name): a for k, a in arrays.items() if k.startswith(name)}


def _matches(columns: Mapping[str, np.ndarray]) -> Matches:
    return Matches(*(columns[c].astype(object) if c in _WORDS else columns[c] for c in _COLUMNS))
