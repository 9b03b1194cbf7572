"""A camera, a lamp and an operator that break promises, each by a stated amount; NumPy, SciPy and tifffile alone.

It shares no line and no constant with the package, so that neither can lean on the other's assumption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import tifffile
from scipy.signal import fftconvolve

WAVELENGTHS = (450, 550, 650)
TILE = 20
MARGIN = 4
"""Pixels of a tile, and of its rim, which is not compared: bands are demosaiced and interpolated."""


@dataclass(frozen=True)
class Habits:
    """What a camera, its lamp and its operator do. The defaults keep every promise of a textbook.

    Counts are those of 12 bits; `light` are counts above black of a perfect diffuser.
    """

    black: float = 60.0
    phases: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    read: float = 2.5
    gain: float = 0.25
    light: float = 3000.0
    full: float = np.inf
    top: float = 4095.0
    shift: int = 1
    curve: float = 0.0
    """Share of the signal that is lost where it reaches 4095 counts: y = x − curve x² / 4095."""
    response: Callable[[np.ndarray], np.ndarray] | None = None
    """What the sensor makes of counts of light, shot noise and all."""
    current: float = 0.0
    """Counts a second of dark current."""
    wander: float | tuple[float, ...] = 0.0
    """Counts by which the black level rises from the first dark to the last shot of all; or of each band."""
    seconds: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Exposures of dark, white and object."""
    series: tuple[float, ...] = ()
    """Exposures of white and object of a series, in place of one."""
    shots: tuple[int, int, int] = (8, 6, 3)
    """Of dark, white and object."""
    after: int = 0
    """Whites of `shots` that are captured after the object, not before it."""
    clock: float = 0.0
    """Seconds from shot to shot, written into the files; 0: the files state no time."""
    drift: float | tuple[float, ...] = 0.0
    """Share by which the lamp sinks from the first white to the last object, or to a white after it; or of each band."""
    course: tuple[float, ...] = (0.0, 1.0)
    """How lamp and black level get there: shares of `drift` and `wander`, evenly in time, with lines between them."""
    flicker: float = 0.0
    """Spread of the lamp's level from shot to shot, share."""
    reddening: float = 0.0
    """Share by which the reddest band drifts more than the bluest."""
    vignette: float = 0.0
    """Share of light that the corners of the view lack, white and object alike."""
    board: tuple[float, float] = (1.0, 1.0)
    """Reflectance of the white at 400 and at 700 nm."""
    strip: float = 0.0
    """Share of the columns in which the white shows the painting, not the board."""
    stray: float = 0.0
    """Share of the mean light of the view that is added everywhere."""
    stray_px: float = 0.0
    """Where it is above 0 that share of the light is spread in place of it, as exp(-distance/stray_px)."""
    iso: tuple[int, int] | None = None
    """Of white and object, written into the files; counts follow."""
    stop: tuple[float, float] | None = None
    """f-number of white and object, written into the files; counts follow."""
    seed: int = 1


def tones(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return tiles of reflectances from 0.002 to 1, (h, w), and where they are compared."""
    down, across = (n // TILE for n in shape)
    made = np.geomspace(0.002, 1.0, down * across)
    made = np.random.default_rng(7).permutation(made).reshape(down, across)
    inner = np.zeros((TILE, TILE), bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    return np.kron(made, np.ones((TILE, TILE))), np.kron(np.ones_like(made), inner) > 0


class Camera:
    """Frames of one sensor of a size, shot after shot under one lamp."""

    def __init__(self, shape: tuple[int, int], habits: Habits, *, line: bool = False) -> None:
        self.shape, self.habits = shape, habits
        self.rng = np.random.default_rng(habits.seed)
        # A line scanner has one line of sensels, which every line of the scan is taken with.
        fixed = np.random.default_rng(99).standard_normal((2, 1 if line else shape[0], shape[1]))
        self.response = 1 + 0.01 * fixed[0]
        self.offset = 0.4 * fixed[1]
        y, x = (np.linspace(-1, 1, n) for n in shape)
        # Behind a scanner's slit the light is even along the scan.
        self.evenness = 1 - habits.vignette * (x**2 if line else (y[:, None] ** 2 + x**2) / 2)
        y, x = np.indices(shape)
        self.phase = np.asarray(habits.phases, float)[2 * (y % 2) + x % 2]

    def frame(
        self,
        scene: np.ndarray | float,
        seconds: float,
        *,
        lamp: float | np.ndarray = 1.0,
        black: float | None = None,
        factor: float = 1.0,
    ) -> np.ndarray:
        """Return the codes of one shot of a reflectance; `factor` is that of ISO and stop."""
        habits = self.habits
        observed = np.broadcast_to(np.asarray(scene, float), self.shape) * self.evenness
        spread = self._spread(observed) if habits.stray_px else observed.mean()
        observed = observed + habits.stray * spread
        counts = habits.light * lamp * seconds * observed * self.response + habits.current * seconds
        counts = habits.gain * self.rng.poisson(counts / habits.gain)
        counts = counts if habits.response is None else habits.response(counts)
        counts = factor * np.minimum(counts - habits.curve * counts**2 / 4095, habits.full)
        level = habits.black if black is None else black
        raw = counts + level + self.phase + self.offset
        raw = np.rint(raw + self.rng.normal(0, habits.read, self.shape))
        return (raw.clip(0, habits.top) * habits.shift).astype(np.uint16)

    def _spread(self, light: np.ndarray) -> np.ndarray:
        """Return the light that falls off exponentially around every point."""
        tall, wide = self.shape
        y, x = np.mgrid[-tall : tall + 1, -wide : wide + 1]
        fall = np.exp(-np.hypot(y, x) / self.habits.stray_px)
        made, all_of_it = (fftconvolve(a, fall, "same") for a in (light, np.ones(self.shape)))
        return made / all_of_it - light


@dataclass(frozen=True)
class Shot:
    """One shot to be written: its role, number, band and codes."""

    target: str
    number: int
    band: int
    seconds: float
    codes: np.ndarray
    tags: list[tuple]


def paint_chart(shape: tuple[int, int], patches: np.ndarray) -> np.ndarray:
    """Return a chart of 6 by 4 patches, (24, bands), on black card, in a grey room, (h, w, bands).

    One chart's patches differ from the mean of charts by 1.5 %.
    """
    own = patches * (1 + 0.015 * np.random.default_rng(24).standard_normal((24, 1)))
    pitch = min((shape[0] - 10) // 4, (shape[1] - 10) // 6)
    top, left = (shape[0] - 4 * pitch) // 2, (shape[1] - 6 * pitch) // 2
    made = np.full((*shape, patches.shape[1]), 0.2)
    made[top - 4 : top + 4 * pitch + 4, left - 4 : left + 6 * pitch + 4] = 0.03
    for i, patch in enumerate(own):
        y, x = top + pitch * (i // 6) + 3, left + pitch * (i % 6) + 3
        made[y : y + pitch - 6, x : x + pitch - 6] = patch
    return made


def session(
    camera: Camera, truth: np.ndarray, bands: int, chart: np.ndarray | None = None
) -> Iterator[Shot]:
    """Yield the darks, whites and shots of the object, one after the other under a lamp that ages.

    A chart, (h, w, bands), is captured like the object, under the lamp as it was at first.
    """
    habits, shape = camera.habits, camera.shape
    every = sum(habits.shots)
    lamps = np.random.default_rng(habits.seed + 1)
    whites, shots = habits.shots[1:]
    times = habits.series or None
    last = whites + shots - 1
    strip = np.arange(shape[1]) < habits.strip * shape[1]
    early = whites - habits.after
    for role, target in enumerate(("dark", "white", "panel")):
        for number in range(habits.shots[role]):
            # Whites before the object come first, then its shots, then whites after it.
            order = early if role == 2 else shots * (role == 1 and number >= early)
            flicker = 1 + habits.flicker * lamps.standard_normal()
            for seconds in times or (habits.seconds[role],):
                for band in range(bands):
                    place = band / max(bands - 1, 1)
                    lean = _of(habits.drift, band) + habits.reddening * place
                    lamp = flicker * (1 - lean * _gone(habits, (order + number) / max(last, 1)))
                    nm = WAVELENGTHS[band % len(WAVELENGTHS)]
                    level = np.interp(nm, (400, 700), habits.board)
                    scene = truth[..., band] if truth.ndim == 3 else truth
                    if role == 1:
                        scene = np.where(strip, scene, level)
                    factor, tags = _settings(habits, role)
                    taken = order + number + habits.shots[0] * (role > 0)
                    if habits.clock:
                        tags.append(_clock(habits, taken))
                    codes = camera.frame(
                        scene if role else 0.0,
                        seconds,
                        lamp=lamp if role else 0.0,
                        black=habits.black
                        + _of(habits.wander, band) * _gone(habits, taken / max(every - 1, 1)),
                        factor=factor,
                    )
                    yield Shot(target, number, band, seconds, codes, tags)

    for number in range(shots if chart is not None else 0):
        for band in range(bands):
            view = chart[..., band]
            codes = camera.frame(view, habits.seconds[2], factor=_settings(habits, 2)[0])
            yield Shot("macbeth", number, band, habits.seconds[2], codes, _settings(habits, 2)[1])


def _of(value: float | tuple[float, ...], band: int) -> float:
    """Return a habit of one band."""
    return value[band] if isinstance(value, tuple) else value


def _gone(habits: Habits, when: float) -> float:
    """Return which share of its drift a lamp has made at a share of the session."""
    return float(np.interp(when, np.linspace(0, 1, len(habits.course)), habits.course))


def _settings(habits: Habits, role: int) -> tuple[float, list[tuple]]:
    """Return what ISO and stop make of the counts of a role, and the tags that state them."""
    factor, tags = 1.0, []
    if habits.iso:
        iso = habits.iso[role == 2]
        factor *= iso / habits.iso[0]
        tags.append((34855, "H", 1, iso, True))
    if habits.stop:
        stop = habits.stop[role == 2]
        factor *= (habits.stop[0] / stop) ** 2
        tags.append((33437, "2I", 1, (round(stop * 10), 10), True))
    return factor, tags


def _clock(habits: Habits, count: int) -> tuple:
    """Return the tag of the time of a shot, the count-th of its band."""
    moment = datetime(2026, 5, 4, 10) + timedelta(seconds=habits.clock * count)
    return (306, "s", 20, moment.strftime("%Y:%m:%d %H:%M:%S"), True)


# --- campaigns ---------------------------------------------------------------------------------

HEAD = """
[campaign]
reference = "cam"
[targets]
dark = "dark"
white = {{ names = "white", reflectance = {white} }}
objects = ["panel"]
[cameras.cam]
"""
EXPOSURE = "{exposure}ms_"
KEYS = {
    "bands": 'kind = "bands"\nfiles = "raw/{target}_{wavelength}nm_EXP{shot}.tif"\n',
    "mosaic": 'kind = "mosaic"\npattern = "RGGB"\nfiles = "raw/{target}_EXP{shot}.tif"\n',
    "sensors": 'kind = "sensors"\nfiles = "raw/{target}_{sensor}_EXP{shot}.tif"\n'
    '[[cameras.cam.sensors]]\nname = "a"\nbands = ["A"]\n'
    '[[cameras.cam.sensors]]\nname = "b"\nbands = ["B"]\n',
    "cube": 'kind = "cube"\nfiles = "raw/{target}.hdr"\n',
    "mirror": 'kind = "cube"\nscan = "mirror"\nfiles = "raw/{target}.hdr"\n',
}
BANDS = {"bands": 3, "mosaic": 1, "sensors": 2, "cube": 3, "mirror": 3}
LINES = 64
"""Of dark and white of a push-broom scanner."""


def write_campaign(
    folder: Path,
    kind: str,
    habits: Habits,
    shape: tuple[int, int] = (160, 200),
    *,
    keys: str = "bits = 12\n",
    white: str = "1.0",
    stated_times: bool = False,
    truth: np.ndarray | None = None,
    chart: np.ndarray | None = None,
) -> Path:
    """Write a campaign of one camera and one panel, and a chart of (24, bands); return its folder."""
    scene = tones(shape)[0] if truth is None else truth
    camera, raw = Camera(shape, habits, line=kind in ("cube", "mirror")), folder / "raw"
    raw.mkdir(parents=True)
    timed = stated_times or habits.series or len({*habits.seconds}) > 1
    if kind in ("cube", "mirror"):
        _write_scans(raw, kind, camera, scene, timed=bool(timed))
    else:
        painted = None if chart is None else paint_chart(shape, chart)
        for shot in session(camera, scene, BANDS[kind], painted):
            middle = {
                "bands": f"_{WAVELENGTHS[shot.band]}nm",
                "mosaic": "",
                "sensors": f"_{'ab'[shot.band % 2]}",
            }[kind]
            time = f"{1000 * shot.seconds:g}ms_" if timed else ""
            path = raw / f"{shot.target}{middle}_{time}{shot.number}.tif"
            tifffile.imwrite(path, shot.codes, photometric="minisblack", extratags=shot.tags)
    table = KEYS[kind].replace("EXP", EXPOSURE if timed else "")
    first, *sensors = table.split("[[", 1)
    series = 'exposures = "merge"\n' if habits.series else ""
    head = HEAD.format(white=white)
    if chart is not None:
        head = head.replace("[cameras", 'charts = { macbeth = "ColorChecker24" }\n[cameras')
    text = head + first + keys + series + "".join("[[" + s for s in sensors)
    (folder / "campaign.toml").write_text(text + "[database]\nnative = true\n")
    return folder


def _write_scans(raw: Path, kind: str, camera: Camera, scene: np.ndarray, *, timed: bool) -> None:
    """Write dark, white and one object as ENVI cubes; the lamp ages line by line."""
    habits, (lines, samples) = camera.habits, camera.shape
    short = LINES if kind == "cube" else lines
    age = np.arange(short + lines)[:, None] / (short + lines - 1)
    strip = np.arange(samples) < habits.strip * samples
    flicker = 1 + habits.flicker * camera.rng.standard_normal(age.shape)
    for role, name in enumerate(("dark", "white", "panel")):
        cube = []
        for band in range(BANDS[kind]):
            lean = _of(habits.drift, band) + habits.reddening * band / (BANDS[kind] - 1)
            lamp = (flicker * (1 - lean * age))[:short] if role == 1 else 0.0
            lamp = (flicker * (1 - lean * age))[short:] if role == 2 else lamp
            if role == 1:
                lamp = np.concatenate([lamp, np.ones((lines - short, 1))])
            level = np.interp(WAVELENGTHS[band], (400, 700), habits.board)
            view = scene[..., band] if scene.ndim == 3 else scene
            observed = np.where(strip, view, level) if role == 1 else view
            cube.append(
                camera.frame(
                    observed if role else 0.0,
                    habits.seconds[role],
                    lamp=lamp,
                    black=habits.black + _of(habits.wander, band) * (0.0, 0.5, 1.0)[role],
                )
            )
        kept = np.stack(cube, -1)[: lines if role == 2 else short]
        write_envi(raw / name, kept, habits.seconds[role] if timed else None)


def write_envi(
    base: Path,
    cube: np.ndarray,
    seconds: float | None = None,
    wavelengths: tuple[int, ...] = WAVELENGTHS,
    more: str = "",
) -> None:
    """Write (lines, samples, bands) line by line with its header."""
    lines, samples, bands = cube.shape
    base.with_suffix(".raw").write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
    tint = "" if seconds is None else f"tint = {1000 * seconds:g}\n"
    base.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ninterleave = bil\n"
        f"header offset = 0\ndata type = 12\nbyte order = 0\nwavelength units = nm\n"
        f"wavelength = {{{', '.join(map(str, wavelengths))}}}\n{tint}{more}"
    )


# --- what a build says and gives ----------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What came of a build: its words, and values, sigma and flags in native pixels, (h, w, bands)."""

    words: str
    refused: bool
    page: str = ""
    """Of the camera, HTML."""
    values: np.ndarray | None = None
    sigma: np.ndarray | None = None
    flags: np.ndarray | None = None


def outcome_of(folder: Path, build: Callable) -> Outcome:
    """Build a campaign; return what it says, and what it has calibrated."""
    words: list[str] = []
    refused = False
    for step in build(folder):
        words += [*map(str, step.problems), *step.warnings]
        refused |= step.state in ("refused", "failed")
    where = folder / "database" / "objects" / "panel" / "native"
    parts: dict[str, np.ndarray] = {}
    if not refused:
        for kind in ("", ".sigma", ".flags"):
            stems = sorted(where.glob("*.flags.tif"))
            planes = [_pages(s.with_name(s.name.replace(".flags", kind))) for s in stems]
            parts[kind] = np.concatenate(planes, -1)
    reported = "\n".join(dict.fromkeys(words))
    page = folder / "database" / "cameras" / "cam" / "report.html"
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    return Outcome(reported, refused, text, *(parts.get(kind) for kind in ("", ".sigma", ".flags")))


def _pages(path: Path) -> np.ndarray:
    """Return the bands of a spectral TIFF, (h, w, bands), without its picture."""
    with tifffile.TiffFile(path) as tiff:
        return np.stack([page.asarray() for page in tiff.pages if page.ndim == 2], -1)
