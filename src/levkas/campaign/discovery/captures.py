"""Records of captures: frames, sensors, captures, refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from levkas.campaign.schema.names import EXPECTED, why_unsafe
from levkas.core.cube import Band
from levkas.core.problems import Problem, Refused

Rows = tuple[tuple[str, ...], ...]


class CaptureRefused(Refused):
    """One capture cannot be built; the others are."""


@dataclass(frozen=True)
class FrameRef:
    """One exposure of one sensor: its file, and the facts in its name.

    Parameters
    ----------
    path : Path
        Of an ENVI cube the header.
    target : str
    sensor : str
        Empty for a camera of one sensor.
    band : str, optional
        Label of the band that the frame shows; None where it shows all, or serves all.
    wavelength : float, optional
        nm, from the name.
    exposure_s : float, optional
        From the name; None where only the file may have it.
    shot, setup : str
    page : int, optional
        Of a multi-page TIFF, from 0. None: the whole file, for a `cube` all its pages.
    order : tuple of int, optional
        Of a `cube` whose bands stand in another order than those of the object's first file: where each of these is.
    object : str
        The one object that a dark or white serves; empty where it serves all.
    tile : str
        The part of the object that it shows: ``r2c3``, or what {tile} matched; empty where it shows all of it.
    """

    path: Path
    target: str
    sensor: str = ""
    band: str | None = None
    wavelength: float | None = None
    exposure_s: float | None = None
    shot: str = ""
    setup: str = ""
    page: int | None = None
    order: tuple[int, ...] | None = None
    object: str = ""
    tile: str = ""


@dataclass(frozen=True)
class SensorFrames:
    """Everything that one sensor saw for one object, templates included.

    Parameters
    ----------
    name : str
        Empty for a camera of one sensor.
    pattern : rows of channel names, or None
    bands : tuple of Band
        That this sensor yields, in order.
    align : "measure" or ((a, b, c), (d, e, f))
        Native px of the camera's first sensor → this one.
    object : tuple of FrameRef
        Shots and exposures; of a `cube` the strips of the scan, in order.
    dark, white : tuple of FrameRef
        With a band where they belong to one, without where they serve all.
    chart : tuple of FrameRef
        Of the chart that takes the place of a white, band by band as the object's.
    without_reference : tuple of str
        Bands that were left out: the chart's reflectance there is unknown.
    remarks : tuple of str
        Why these darks and whites were taken, where others could have been.
    """

    name: str
    pattern: Rows | None
    bands: tuple[Band, ...]
    align: str | tuple[tuple[float, ...], ...]
    object: tuple[FrameRef, ...]
    dark: tuple[FrameRef, ...] = ()
    white: tuple[FrameRef, ...] = ()
    chart: tuple[FrameRef, ...] = ()
    without_reference: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Capture:
    """One object by one camera under one setup; the setup is empty for the default one.

    `tiles` are the parts of an object that is larger than a frame, each with its own frames, darks and whites; `sensors`
    then has the frames of all of them. `tile` is the name of such a part.
    """

    object: str
    camera: str
    setup: str
    sensors: tuple[SensorFrames, ...]
    tiles: tuple[Capture, ...] = ()
    tile: str = ""

    @property
    def bands(self) -> tuple[Band, ...]:
        """All bands, sensor by sensor."""
        return tuple(band for sensor in self.sensors for band in sensor.bands)

    @property
    def layer(self) -> str:
        """Camera and setup as frames are named: ``d80@45-degree``."""
        return f"{self.camera}@{self.setup}" if self.setup else self.camera

    @property
    def frame(self) -> str:
        """The layer, and its tile where this is one: ``d80#r2c3``."""
        return f"{self.layer}#{self.tile}" if self.tile else self.layer

    def boxes(
        self, frames: Mapping[str, tuple[tuple[int, int, int, int], ...]]
    ) -> dict[str, list[tuple[int, int, int, int]]]:
        """Return the rectangles of its frames, [x, y, width, height] in native px, by sensor.

        A frame is CAMERA, CAMERA@SETUP, or either with :BAND, which is the sensor that records that band.
        """
        found: dict[str, list[tuple[int, int, int, int]]] = {}
        for frame, boxes in frames.items():
            layer, _, band = frame.partition(":")
            for sensor in self.sensors if layer == self.layer else ():
                if not band or any(b.label == band for b in sensor.bands):
                    found.setdefault(sensor.name, []).extend(boxes)
        return found


Refusals = dict[tuple[str, str, str], Refused]
"""(object, camera, setup) → what is wrong with that capture alone."""


def require_name(name: str) -> None:
    """Refuse an object of whose name no file can be made on every system; raises CaptureRefused."""
    if why := why_unsafe(name):
        raise CaptureRefused(
            Problem(
                "E_VALUE",
                f"{name!r} cannot be part of a file name: {why}",
                field="{target}",
                found=name,
                expected=EXPECTED,
                fix="Rename the frames, or list the other objects in `targets.objects`.",
            )
        )
