"""One file a band: which band each file shows, and whether all of them are there."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from math import nan
from typing import TYPE_CHECKING

from levkas.campaign.discovery.bands import count_problem, described
from levkas.campaign.discovery.captures import CaptureRefused, FrameRef
from levkas.campaign.discovery.patterns import natural
from levkas.core.cube import Band, band_labels
from levkas.core.problems import Problem

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera

Key = float | str
SAME_NM = 1e-6
"""Between wavelengths that are one, as files and campaign.toml write them."""


def band_key(frame: FrameRef) -> Key | None:
    """What tells a frame's band: its wavelength, else its name, else nothing."""
    return frame.wavelength if frame.wavelength is not None else frame.band


def shown(key: Key | None) -> str:
    """Return a band's key as text.

    >>> shown(366.55)
    '366.55 nm'
    """
    return f"{key:g} nm" if isinstance(key, float) else str(key)


def bands_by_name(
    camera: Camera, frames: Sequence[FrameRef], others: set[Key], folder: str
) -> tuple[list[FrameRef], tuple[Band, ...]]:
    """Order frames whose names tell their band, and check them against what is expected.

    Parameters
    ----------
    camera : Camera
    frames : sequence of FrameRef
        Of one object.
    others : set
        Bands of the camera's other objects and whites: expected too where nothing is declared.
    folder : str
        For messages.

    Returns
    -------
    frames : list of FrameRef
        With labels as their bands, band after band.
    bands : tuple of Band

    Raises
    ------
    CaptureRefused
        For a missing band, one too many, or a name without its wavelength.
    """
    found = {band_key(f) for f in frames}
    if None in found:
        raise CaptureRefused(_nameless(camera, [f for f in frames if band_key(f) is None]))
    keys = sorted((k for k in found if k is not None), key=_order)
    by_wavelength = all(isinstance(k, float) for k in keys)
    declared: Sequence[Key] | None = camera.centres if by_wavelength else camera.bands
    keys = _checked(camera, keys, declared, others, folder)
    if by_wavelength:
        centres = [float(k) for k in keys]
        names = camera.bands or _names_of(frames, keys) or tuple(band_labels(centres))
    else:
        names, centres = tuple(str(k) for k in keys), list(camera.centres or [nan] * len(keys))
    if len(names) != len(keys):
        raise CaptureRefused(count_problem(camera, "bands", len(names), len(keys), "files", folder))
    bands = tuple(Band(n, w) for n, w in zip(names, centres, strict=True))
    labels = dict(zip(keys, names, strict=True))
    ranks = {key: i for i, key in enumerate(keys)}
    ordered = sorted(frames, key=lambda f: (ranks[_sure(f)], f.exposure_s or 0.0))
    return [replace(f, band=labels[_sure(f)]) for f in ordered], bands


def label_templates(
    templates: Sequence[FrameRef], frames: Sequence[FrameRef], bands: Sequence[Band]
) -> list[FrameRef]:
    """Give templates the labels of the bands they belong to; those of other bands are left out.

    Parameters
    ----------
    templates : sequence of FrameRef
        As found.
    frames : sequence of FrameRef
        Of the object, labelled.
    bands : sequence of Band
    """
    labels: dict[Key, str] = {b.wavelength: b.label for b in bands if b.wavelength == b.wavelength}
    labels |= {f.wavelength: f.band for f in frames if f.wavelength is not None and f.band}
    labels |= {b.label: b.label for b in bands}
    result = []
    for frame in templates:
        key = band_key(frame)
        if key is None or frame.page is not None:
            result.append(frame)
        elif key in labels:
            result.append(replace(frame, band=labels[key]))
    return result


def _order(key: Key) -> tuple[int, float, list[tuple[int, int, str]]]:
    return (0, key, []) if isinstance(key, float) else (1, 0.0, natural(key))


def _sure(frame: FrameRef) -> Key:
    key = band_key(frame)
    return "" if key is None else key


def _names_of(frames: Sequence[FrameRef], keys: Sequence[Key]) -> tuple[str, ...] | None:
    """Names that stand beside wavelengths in the files' names."""
    names = {f.wavelength: f.band for f in frames if f.wavelength is not None}
    found = tuple(str(names[k]) for k in keys if isinstance(k, float) and names.get(k))
    return found if len(set(found)) == len(keys) else None


def _checked(
    camera: Camera,
    keys: list[Key],
    declared: Sequence[Key] | None,
    others: set[Key],
    folder: str,
) -> list[Key]:
    """Return the keys in their order, or refuse."""
    alike = {k for k in others if isinstance(k, float) == isinstance(keys[0], float)}
    expected = list(declared) if declared else sorted({*keys, *alike}, key=_order)
    near = _Near(keys)
    match = {k: near.same(k) for k in expected}
    missing = [k for k in expected if match[k] is None]
    taken = set(match.values())
    surplus = [k for k in keys if k not in taken]
    if not missing and not surplus:
        return [k for k in match.values() if k is not None]
    told = described(declared) if declared else f"other targets have {len(expected)} bands"
    lack = "missing " if missing else "not declared: "
    field = "wavelengths" if isinstance(expected[0], float) else "bands"
    raise CaptureRefused(
        Problem(
            "E_BAND_MISSING" if missing else "E_BAND_COUNT",
            f"{camera.name}: {told}, the folder has {len(keys)} ({lack}{_listed(missing or surplus)})",
            folder,
            f"cameras.{camera.name}.{field}",
            len(keys),
            len(expected),
            f"Add the missing files, or write the bands that there are as `{field}`."
            if missing
            else f"Take the files away, or add them to `{field}`.",
        )
    )


class _Near:
    """Keys among which one is looked up, wavelengths within 1e-6 nm; thousands of bands are."""

    def __init__(self, keys: Sequence[Key]) -> None:
        self._labels = {k for k in keys if not isinstance(k, float)}
        self._wavelengths = sorted(k for k in keys if isinstance(k, float))

    def same(self, key: Key) -> Key | None:
        """Return the key that is alike, None without one."""
        if not isinstance(key, float):
            return key if key in self._labels else None
        place = bisect_left(self._wavelengths, key - SAME_NM)
        found = self._wavelengths[place : place + 1]
        return found[0] if found and found[0] < key + SAME_NM else None


def _listed(keys: Sequence[Key]) -> str:
    some, more = keys[:6], " …" if len(keys) > 6 else ""
    if all(isinstance(k, float) for k in some):
        return ", ".join(f"{k:g}" for k in some) + f"{more} nm"
    return ", ".join(map(shown, some)) + more


def _nameless(camera: Camera, frames: list[FrameRef]) -> Problem:
    return Problem(
        "E_BAND_MISSING",
        f"{camera.name}: a file's name does not tell its band",
        str(frames[0].path),
        f"cameras.{camera.name}.files",
        frames[0].path.name,
        "a pattern with {wavelength} or {band}",
        "Mend the pattern that this file fits.",
    )
