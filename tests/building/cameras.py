"""Small campaigns of one camera of any kind, what goes wrong in them, and what calibration alone makes of them.

The camera is that of `tests/promises`, which shares no line with the package. Changes are made to the files that it has written.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).parents[1] / "promises"))
from camera import Habits, tones, write_campaign

from levkas.campaign.campaign import Campaign, load_campaign
from levkas.campaign.discovery.captures import Capture
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.cube import Cube, Flag
from levkas.core.problems import Problem, Refused
from levkas.stages.budget import budget_of
from levkas.stages.calibrate import develop
from levkas.stages.parts import CalibratedCapture
from levkas.stages.template_cache import TemplateCache

SHAPE = (80, 100)
BLACK, LIGHT = 60.0, 3000.0
SHOTS = (4, 4, 2)
"""Of dark, white and object."""
KINDS = ("bands", "mosaic", "sensors", "cube", "mirror")
RGGB = np.array([[0, 1], [1, 2]])
Change = Callable[[Path], object]


def write(
    folder: Path,
    kind: str = "bands",
    *changes: Change,
    shape: tuple[int, int] = SHAPE,
    keys: str = "bits = 12\n",
    white: str = "1.0",
    truth: np.ndarray | None = None,
    chart: np.ndarray | None = None,
    **habits: Any,
) -> Path:
    """Write a campaign of one camera "cam" and one object "panel"; then make the changes."""
    own = Habits(**({"shots": SHOTS} | habits))
    write_campaign(folder, kind, own, shape, keys=keys, white=white, truth=truth, chart=chart)
    for change in changes:
        change(folder)
    return folder


# --- changes ------------------------------------------------------------------------------------


def frames(pattern: str, function: Callable[[np.ndarray], np.ndarray], **more: Any) -> Change:
    """Return what writes frames of `raw` anew by a function of their codes; of scans, (lines, samples, bands)."""

    def change(folder: Path) -> None:
        paths = [p for p in sorted((folder / "raw").glob(pattern)) if p.suffix != ".raw"]
        assert paths, pattern
        for path in paths:
            if path.suffix == ".hdr":
                write_scan(path, function(read_scan(path)))
            else:
                made = function(tifffile.imread(path))
                tifffile.imwrite(path, made, photometric="minisblack", metadata=None, **more)

    return change


def region(pattern: str, place: Any, factor: float) -> Change:
    """Return what makes a part of frames brighter or darker by a factor."""

    def function(codes: np.ndarray) -> np.ndarray:
        made = codes.astype(float)
        made[place] = BLACK + factor * (made[place] - BLACK)
        return np.rint(made).clip(0, 4095).astype(codes.dtype)

    return frames(pattern, function)


def brighter(pattern: str, factor: float) -> Change:
    """Return what makes frames brighter by a factor."""
    return region(pattern, ..., factor)


def set_at(pattern: str, place: Any, value: float, dtype: str = "f4") -> Change:
    """Return what sets pixels of frames to a value, as numbers of a type."""

    def function(codes: np.ndarray) -> np.ndarray:
        made = codes.astype(dtype)
        made[place] = value
        return made

    return frames(pattern, function)


def reshot(pattern: str, scene: np.ndarray) -> Change:
    """Return what replaces frames by others of a scene, (h, w)."""
    rng = np.random.default_rng(11)

    def function(codes: np.ndarray) -> np.ndarray:
        light = LIGHT * np.broadcast_to(scene[: codes.shape[0]], codes.shape[:2])
        noisy = BLACK + rng.normal(light, np.sqrt(6 + 0.25 * light))
        noisy = noisy if codes.ndim == 2 else np.repeat(noisy[..., None], codes.shape[2], 2)
        return np.rint(noisy).clip(0, 4095).astype(np.uint16)

    return frames(pattern, function)


def drop(*patterns: str) -> Change:
    """Return what takes frames away."""
    return lambda folder: [p.unlink() for one in patterns for p in (folder / "raw").glob(one)]


def text(old: str, new: str, name: str = "campaign.toml") -> Change:
    """Return what replaces text of a file."""

    def change(folder: Path) -> None:
        path = folder / name
        said = path.read_text()
        assert old in said, old
        path.write_text(said.replace(old, new))

    return change


def key(line: str) -> Change:
    """Return what adds a line to the camera's keys."""
    return text("[cameras.cam]\n", f"[cameras.cam]\n{line}\n")


def referenced(folder: Path) -> None:
    """Add a photograph, "photo", as the reference: what is not the reference may be streamed."""
    (folder / "photo").mkdir()
    codes = np.rint(255 * tones(SHAPE)[0]).astype(np.uint8)
    tifffile.imwrite(folder / "photo/panel.tif", codes, photometric="minisblack")
    text('reference = "cam"', 'reference = "photo"')(folder)
    photo = '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'
    text("[cameras.cam]", photo + "[cameras.cam]")(folder)


def read_scan(header: Path) -> np.ndarray:
    """Return a cube, (lines, samples, bands), of an ENVI header that `write_scan` or the camera wrote."""
    said = dict(line.split(" = ", 1) for line in header.read_text().splitlines() if " = " in line)
    lines, samples, bands = (int(said[n]) for n in ("lines", "samples", "bands"))
    kind = {"12": "<u2", "4": "<f4", "1": "u1", "2": "<i2"}[said["data type"]]
    codes = np.fromfile(header.with_suffix(".raw"), kind)
    return codes.reshape(lines, bands, samples).transpose(0, 2, 1)


def write_scan(header: Path, cube: np.ndarray, **more: object) -> None:
    """Write a cube beside a header, which keeps what else it says; `more` with _ for blanks, None takes a key away."""
    said = dict(line.split(" = ", 1) for line in header.read_text().splitlines() if " = " in line) if header.exists() else {
        "interleave": "bil", "byte order": "0"}  # fmt: skip
    codes = {"uint16": 12, "float32": 4, "uint8": 1, "int16": 2}
    rows = dict(zip(("lines", "samples", "bands"), cube.shape, strict=True))
    said |= rows | {"data type": codes[cube.dtype.name]}
    said |= {name.replace("_", " "): value for name, value in more.items()}
    header.with_suffix(".raw").write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
    header.write_text("ENVI\n" + "".join(f"{k} = {v}\n" for k, v in said.items() if v is not None))


# --- what calibration makes of it ---------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """What came of the calibration of one object: a native cube, or problems."""

    problems: Sequence[Problem]
    native: CalibratedCapture | None = None
    campaign: Campaign | None = None
    capture: Capture | None = None

    @property
    def cube(self) -> Cube:
        """All bands, in native pixels."""
        assert self.native is not None, [str(problem) for problem in self.problems]
        cubes = [*self.native.cubes.values()]
        sigma = None if cubes[0].sigma is None else np.concatenate([c.sigma for c in cubes], 2)
        return Cube(
            np.concatenate([c.values for c in cubes], 2),
            np.concatenate([c.flags for c in cubes], 2),
            sigma,
            tuple(band for c in cubes for band in c.bands),
            cubes[0].quantity,
        )

    @property
    def words(self) -> list[str]:
        """Warnings, without the one that names the key of a white's reflectance."""
        assert self.native is not None, [str(problem) for problem in self.problems]
        said = self.native.warnings
        return [one for one in said if "targets.white.reflectance" not in one]

    @property
    def measured(self) -> dict[str, Any]:
        """What was measured of the first sensor."""
        assert self.native is not None
        return next(iter(self.native.measured.values()))

    @property
    def budget(self) -> dict[str, Any]:
        """Rows of the budget by their names."""
        assert self.native is not None
        rows = budget_of(
            self.campaign, self.capture, self.native.measured, quantity=self.native.quantity
        )
        return {row.name: row for row in rows}

    def told(self, *tokens: str) -> bool:
        """Whether one warning has all of some numbers, labels, files or keys."""
        return any(all(token in one for token in tokens) for one in self.words)


def developed(folder: Path, name: str = "panel") -> Made:
    """Calibrate one object of a campaign, or return why not."""
    try:
        campaign = load_campaign(folder)
        captures, refused = find_captures(campaign)
        for problem in refused.values():
            raise problem
        capture = next(one for one in captures if (one.object, one.camera) == (name, "cam"))
        native = develop(capture, campaign, TemplateCache(folder / "kept"))
    except Refused as error:
        return Made(error.problems)
    return Made((), native, campaign, capture)


def own_sensels(values: np.ndarray, kind: str) -> np.ndarray:
    """Return what was measured, not interpolated: of a mosaic RGGB one plane, (h, w, 1)."""
    if kind != "mosaic":
        return values
    y, x = np.indices(values.shape[:2])
    return np.take_along_axis(values, RGGB[y % 2, x % 2][..., None], 2)


def errors(made: Made, kind: str, truth: np.ndarray | None = None) -> tuple[float, float, float]:
    """Return bias, its standard error, both relative, and the spread of errors over sigma, where nothing is flagged."""
    cube = made.cube
    values, flags = own_sensels(cube.values, kind), own_sensels(cube.flags, kind)
    tone, inner = tones(values.shape[:2])
    tone = (tone if truth is None else np.asarray(truth, float))[..., None]
    good = inner[..., None] & (flags & ~np.uint8(Flag.BLACK) == 0)
    off = (values - tone)[good]
    level = np.broadcast_to(tone, values.shape)[good]
    bright = level > 0.02
    ratio = off[bright] / level[bright]
    spread = np.nan
    if cube.sigma is not None:
        spread = float(np.std(off / own_sensels(cube.sigma, kind)[good]))
    assert good.mean() > 0.1
    return float(ratio.mean()), float(ratio.std() / np.sqrt(len(ratio))), spread
