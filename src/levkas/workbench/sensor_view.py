"""What is looked at: one sensor of one camera of one object, known by an id that is never a path."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import Capture, SensorFrames


@dataclass(frozen=True)
class SensorView:
    """One sensor of a capture; most cameras have one."""

    capture: Capture
    sensor: SensorFrames

    @property
    def key(self) -> str:
        """Id."""
        return id_of(
            self.capture.object, self.capture.layer, "" if self.is_first else self.sensor.name
        )

    @property
    def is_first(self) -> bool:
        """Whether edits.toml names it by its camera alone."""
        return self.sensor == self.capture.sensors[0]

    @property
    def labels(self) -> list[str]:
        """Labels of its bands."""
        return [band.label for band in self.sensor.bands]


def id_of(name: str, layer: str, sensor: str = "") -> str:
    """Return the id of a camera of an object, of its first sensor unless another is named.

    >>> id_of("icon1", "d80"), id_of("icon1", "msbs", "ccd2") == id_of("icon1", "msbs")
    ('081b6cfe9096', False)
    """
    parts = [name, layer, sensor] if sensor else [name, layer]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]


def sensor_of(capture: Capture, band: str) -> SensorFrames:
    """Return the sensor that recorded a band; the first where none did."""
    found = (s for s in capture.sensors if any(b.label == band for b in s.bands))
    return next(found, capture.sensors[0])
