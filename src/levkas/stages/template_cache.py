"""Templates that several objects share: averaged once, kept beside the database."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from levkas.core.files import make_folder, remove, replacing
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from levkas.calibration.summary import Summary
    from levkas.calibration.templates import Template
    from levkas.campaign.discovery.captures import FrameRef

Made = TypeVar("Made", "Template", "Summary")
Digests = Callable[[Path], Mapping[Path, str]]


class TemplateCache:
    """Templates by the content of their frames.

    Parameters
    ----------
    folder : Path
        Where they are kept.
    digests : callable, optional
        Return the hashes of the files of a frame. Without it nothing is kept: a template that one object alone needs
        is not worth its disk space.

    Attributes
    ----------
    used : set of str
        Names of the files that were read or written since `used` was cleared.
    """

    def __init__(self, folder: Path, digests: Digests | None = None) -> None:
        self.folder, self.digests = folder, digests
        self.used: set[str] = set()

    def template(
        self,
        frames: Sequence[FrameRef],
        average: Callable[[], Template],
        **parameters: object,
    ) -> Template:
        """Return the template of some frames above a `level` without light, as it is kept or by `average`."""
        known = {**parameters, "level": _digest(parameters.get("level"))}
        return self._kept(frames, repr(sorted(known.items())), average, (_write, _read))

    def summary(self, frame: FrameRef, make: Callable[[], Summary]) -> Summary:
        """Return the summary of a frame, as it is kept or by `make`."""
        return self._kept([frame], "summary", make, (_write_summary, _read_summary))

    def _kept(
        self,
        frames: Sequence[FrameRef],
        what: str,
        make: Callable[[], Made],
        files: tuple[Callable[[Any, Made], None], Callable[[Any], Made]],
    ) -> Made:
        """Return what is kept of some frames, else make and keep it, but of frames that serve one object alone.

        A file that was damaged on the disk fails its checksum and is made anew.
        """
        digests_of = self.digests
        if digests_of is None or all(one.object for one in frames):
            return make()
        digest = hashlib.sha256(repr((what, made_with())).encode())
        for frame in frames:
            content = list(digests_of(frame.path).values())
            digest.update(f"{content}:{frame.page}:{frame.order}:{frame.exposure_s};".encode())
        path = self.folder / f"{digest.hexdigest()[:24]}.npz"
        self.used.add(path.name)
        write, read = files
        try:
            with np.load(path, allow_pickle=False) as stored:
                return read(stored)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            made = make()
        make_folder(self.folder)
        with replacing(path) as handle:
            write(handle, made)
        return made

    def remove_all_but(self, names: Collection[str]) -> None:
        """Remove the templates that no calibration is made with; raises WriteRefused."""
        for path in sorted(self.folder.glob("*.npz")):
            if path.name not in names:
                remove(path)


def _digest(level: Any) -> str:
    return (
        "" if level is None else hashlib.sha256(np.asarray(level, np.float32).tobytes()).hexdigest()
    )


def _read(stored: Any) -> Template:
    from levkas.calibration.templates import DarkFit, ShotLevels, Template  # heavy

    variance = stored["variance"]
    exposure, times = float(stored["exposure_s"]), stored["times_s"]
    levels, error = stored["levels"], stored["level_error"]
    differing, apart = tuple(stored["differing"].tolist()), float(stored["apart"])
    moments = tuple(times.tolist()) if times.size else None
    shots = ShotLevels(levels, error, moments, differing, apart)
    fit = None
    if "fit_variance" in stored:
        noise, zeros, *blacks = stored["fit"].tolist()
        fit = DarkFit(stored["fit_variance"], tuple(blacks), noise, zeros)
    return Template(
        mean=stored["mean"],
        variance=variance if variance.size else None,
        count=int(stored["count"]),
        saturated=stored["saturated"],
        black=stored["black"],
        exposure_s=None if np.isnan(exposure) else exposure,
        fit=fit,
        shots=shots if levels.size else None,
    )


def _write(handle: Any, template: Template) -> None:
    more: dict[str, Any] = {}
    if (fit := template.fit) is not None:
        more = {"fit_variance": fit.variance, "fit": [fit.noise, fit.zeros, *fit.blacks]}
    none, shots = np.zeros((0, 0)), template.shots
    np.savez(
        handle,
        mean=template.mean,
        variance=np.zeros(0, np.float32) if template.variance is None else template.variance,
        count=template.count,
        saturated=template.saturated,
        black=template.black,
        exposure_s=np.nan if template.exposure_s is None else template.exposure_s,
        levels=shots.levels if shots else none,
        level_error=shots.error if shots else none.ravel(),
        times_s=np.array((shots and shots.times_s) or ()),
        differing=np.array(shots.differing if shots else (), int),
        apart=shots.apart if shots else 0.0,
        **more,
    )


def _read_summary(stored: Any) -> Summary:
    from levkas.calibration.summary import Summary  # heavy

    top, constant = stored["ends"].tolist()
    same = None if np.isnan(constant) else constant
    sample, codes = stored["sample"], stored["codes"]
    return Summary(sample, top, same, codes if codes.size else sample.ravel())


def _write_summary(handle: Any, summary: Summary) -> None:
    constant = np.nan if summary.constant is None else summary.constant
    ends = np.array([summary.top, constant])
    same = summary.codes.size == summary.sample.size  # what is in both is kept once
    np.savez(
        handle, sample=summary.sample, codes=summary.codes[:0] if same else summary.codes, ends=ends
    )
