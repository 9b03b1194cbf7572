"""Kinds of cameras: one row a kind, with all that differs between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from levkas.core.problems import closest_match


@dataclass(frozen=True)
class CameraKind:
    """What a camera of some kind delivers, and what follows of it.

    Parameters
    ----------
    bands_in : str
        Where its bands are kept apart: in the ``"pattern"`` of a mosaic, in one ``"file"`` that holds them all, in
        ``"files"``, one each, or by ``"sensors"`` behind one lens, of which each may have a pattern.
    develop : str
        ``MODULE:FUNCTION`` that makes calibrated values of the frames of a sensor (`SensorCapture` → `SensorCube`); nothing of
        scans, which `levkas.stages.scans` calibrates line by line.
    is_calibrated : bool
        Whether its frames are raw: with black level, noise, dark and white.
    is_scanned : bool
        Whether its lines are exposed one after another, so that dark and white are lines and files are strips.
    by_chart : bool
        Whether a colour chart may take the place of a white frame.
    reads_pages : bool
        Whether it takes all pages of a file, and not the first alone.
    one_scan : bool
        Whether its bands are maps of one scan: they share one map, for which the evidence of all is gathered, and may be
        sampled far more coarsely than the reference.
    declares_shots : bool
        Whether several files of one band are a mistake unless they are declared to be shots.
    keys : tuple of str
        Keys of its table that have no meaning for other kinds.
    fields : tuple of str
        Fields of its patterns of files that have no meaning for other kinds.
    rank : int
        Of several cameras, `levkas look` proposes the one with the highest as the reference.
    """

    bands_in: Literal["pattern", "file", "files", "sensors"]
    develop: str
    is_calibrated: bool = True
    is_scanned: bool = False
    by_chart: bool = False
    reads_pages: bool = False
    one_scan: bool = False
    declares_shots: bool = False
    keys: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    rank: int = 1

    @property
    def is_cube(self) -> bool:
        """Whether a file of raw frames holds all bands."""
        return self.bands_in == "file" and self.is_calibrated

    @property
    def is_demosaiced(self) -> bool:
        """Whether the pattern of a sensor holds channels, which are interpolated; a mosaic behind filters is equalised."""
        return self.bands_in in ("pattern", "sensors")

    @property
    def is_broad(self) -> bool:
        """Whether its channels are broad: known by sensitivities, not by wavelengths."""
        return self.is_demosaiced or not self.is_calibrated


_DEVELOP = "levkas.stages.calibrate"
KINDS: dict[str, CameraKind] = {
    "mosaic": CameraKind(
        bands_in="pattern",
        develop=f"{_DEVELOP}:develop_mosaic",
        by_chart=True,
        keys=("pattern", "bands", "demosaic"),
        rank=3,
    ),
    "bands": CameraKind(
        bands_in="files",
        develop=f"{_DEVELOP}:develop_bands",
        by_chart=True,
        declares_shots=True,
        keys=("pattern", "bands"),
        fields=("band", "wavelength"),
        rank=4,
    ),
    "sensors": CameraKind(
        bands_in="sensors",
        develop=f"{_DEVELOP}:develop_mosaic",
        by_chart=True,
        keys=("sensors", "demosaic"),
        fields=("sensor",),
        rank=2,
    ),
    "cube": CameraKind(
        bands_in="file",
        develop="",
        is_scanned=True,
        reads_pages=True,
        keys=("bands", "scan"),
        rank=2,
    ),
    "image": CameraKind(
        bands_in="file",
        develop=f"{_DEVELOP}:develop_image",
        is_calibrated=False,
        declares_shots=True,
        keys=("bands",),
    ),
    "maps": CameraKind(
        bands_in="file",
        develop="levkas.stages.maps:develop_maps",
        is_calibrated=False,
        reads_pages=True,
        one_scan=True,
        declares_shots=True,
        keys=("bands",),
        fields=("band", "wavelength"),
        rank=0,
    ),
}
"""Key `kind` of a camera in campaign.toml. A new kind is a row here and the function that it names."""


def known_kind(name: str) -> str:
    """Return the name of a kind; raises ValueError where there is none of that name.

    >>> known_kind("mosaic")
    'mosaic'
    """
    if name not in KINDS:
        *most, last = map(repr, KINDS)
        near = closest_match(name, KINDS)
        raise ValueError(f"must be {', '.join(most)} or {last}" + (f". {near}" if near else ""))
    return name


def keys_of_others(kind: str) -> dict[str, tuple[str, ...]]:
    """Return the keys that only other kinds have in their tables, and which kinds these are.

    >>> keys_of_others("image")["pattern"]
    ('mosaic', 'bands')
    """
    return _of_others(kind, {name: row.keys for name, row in KINDS.items()})


def fields_of_others(kind: str) -> dict[str, tuple[str, ...]]:
    """Return the fields that only other kinds have in their patterns, and which kinds these are.

    >>> fields_of_others("bands")
    {'sensor': ('sensors',)}
    """
    return _of_others(kind, {name: row.fields for name, row in KINDS.items()})


def _of_others(kind: str, words: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    foreign = dict.fromkeys(
        word for own in words.values() for word in own if word not in words[kind]
    )
    return {word: tuple(name for name, own in words.items() if word in own) for word in foreign}
