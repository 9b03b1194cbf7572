"""Simulated campaigns: which icons, which cameras, how hard; frame by frame on to the disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from math import prod
from pathlib import Path

import numpy as np

from levkas.campaign.camera_kinds import KINDS
from levkas.core.files import Folder, publishing
from levkas.core.ownership import require_outside, stands_in
from levkas.simulation.cameras import BandModel, CameraModel, camera_models, relit, response_table
from levkas.simulation.capture import (
    WHITE_REFLECTANCE,
    PaintingView,
    SimulatedCamera,
    SimulatedFrame,
    key,
    view_painting,
)
from levkas.simulation.charts import chart_panel, paint_chart
from levkas.simulation.icon import paint_icon
from levkas.simulation.lighting import SETUPS
from levkas.simulation.optics import Viewpoint, turn
from levkas.simulation.painting import Painting, Panel, make_uneven
from levkas.simulation.pigments import WAVELENGTHS, draw_pigments, paint_spectra
from levkas.simulation.presets import (
    REFERENCE,
    UNEVEN_DEG,
    Preset,
    choose_cameras,
    choose_preset,
    choose_setups,
    choose_tiles,
    refusal,
)
from levkas.simulation.rendering import tabulate
from levkas.simulation.truth import SimulatedTruth

CHART = "macbeth"
SETUP_CAMERA = "d80"


@dataclass(frozen=True)
class SimulationStep:
    """Progress: `done` of `total` units; `finished` where a painting or a target is done."""

    done: int
    total: int
    label: str
    finished: bool = False

    @property
    def line(self) -> str:
        """The step as a line of a log."""
        return f"{self.done}/{self.total} {self.label}"


@dataclass(frozen=True)
class Simulated(SimulationStep):
    """The last item: what was written."""

    campaign: Path = Path()
    truth: SimulatedTruth | None = None
    files: int = 0
    megabytes: float = 0.0


def simulate_campaign(
    folder: Path | str,
    *,
    seed: int | np.random.Generator = 1,
    preset: str | Preset = "default",
    scale: float | None = None,
    objects: int = 1,
    cameras: Sequence[str] | None = None,
    setups: bool | Sequence[str] = False,
    tiles: str | Sequence[str] | None = None,
) -> Iterator[SimulationStep]:
    """Simulate a campaign into `folder`: `raw/`, `truth/` and a campaign.toml that builds.

    Parameters
    ----------
    folder : path
        A new or empty one; it takes its name when it is whole.
    seed : int or Generator
        The same one gives the same bytes, also of any subset of cameras and objects.
    preset : str or Preset
        ``"default"``, ``"small"`` for a demonstration, ``"hard"``, ``"full"`` for the size of the
        real cameras, about 2.6 GB.
    scale : float, optional
        Size over that of the real cameras, 0 < scale <= 1, no unit; instead of the preset's.
    objects : int, >= 1
        Icons to simulate.
    cameras : sequence of str, optional
        All five if left out; the reference, lctf-vis, is always among them.
    setups : bool or sequence of str
        Also d80 under these lightings of `presets.OTHER_SETUPS`; True is one lamp at 45 degrees.
        Ground and leaf then lean by 5 degrees, unless the preset has its own unevenness.
    tiles : str or sequence of str, optional
        Rows and columns of frames that show an object together: ``"3x4"`` of every camera but the line scanner,
        ``"d80=3x4"`` of one, ``"v10=1x3"`` passes of the line scanner, each of which wobbles by itself. A camera keeps its sampling and has a smaller sensor; a stage moves it, and its record is
        beside campaign.toml. No chart is captured then.

    Yields
    ------
    Step
        The last one is `Simulated`.

    Raises
    ------
    SimulationRefused
        On an unknown preset, camera or lighting, a scale that is not in (0, 1], no object, or a
        folder that holds something.
    levkas.core.disk.WriteRefused
        Where the folder cannot be written or the disk is full.

    Examples
    --------
    >>> *_, last = simulate_campaign(folder / "icon", preset="small", scale=0.1, cameras=["d80"])
    >>> sorted(path.name for path in (folder / "icon").iterdir() if path.is_dir())
    ['raw', 'truth']
    """
    folder = Path(folder)
    folder = folder.resolve() if folder.is_symlink() else folder
    chosen = choose_preset(preset, scale=scale, objects=objects)
    chosen = replace(chosen, charts=chosen.charts and not tiles)
    models = choose_tiles(choose_cameras(chosen, cameras), tiles, chosen.overlap)
    lightings = choose_setups(setups)
    if chosen.unevenness_deg is None and lightings:
        chosen = replace(chosen, unevenness_deg=UNEVEN_DEG)
    lightings = lightings if SETUP_CAMERA in models else ()
    require_outside(folder, fix="Give another folder.")
    if found := stands_in(folder):
        why = "the folder is not empty" if found == "a folder" else f"{found} stands there"
        raise refusal(why, "folder", str(folder), "a new folder")
    root = int(np.random.default_rng(seed).integers(2**62))
    session = SimulatedSession(chosen, models, root, objects)
    need = _bytes_needed(models, objects + int(chosen.charts))
    need += len(lightings) * _bytes_needed(
        {k: models[k] for k in {SETUP_CAMERA} & {*models}}, objects
    )
    with publishing(folder, bytes_needed=need) as aside:
        writer = FrameWriter(aside)
        yield from session.run(writer, lightings)
        truth = session.truth()
        truth.save(aside.path / "truth")
        write_tables(aside, models)
        write_positions(aside, models, chosen.overlap)
        write_campaign_toml(
            aside, models, session.panels,
            chart=CHART if chosen.charts else None,
            setups=lightings,
        )  # fmt: skip
    yield Simulated(
        session.total, session.total, f"{writer.files} files", True,
        folder / "campaign.toml", truth, writer.files, writer.bytes / 1e6,
    )  # fmt: skip


def _bytes_needed(models: dict[str, CameraModel], targets: int) -> int:
    total = 0
    for m in models.values():
        planes = len(m.bands) if not KINDS[m.kind].is_broad else len(m.sensors)
        frame = 2 * m.width * m.height * planes
        total += frame * targets * m.shots * prod(m.tiles)
        total += frame * (m.whites + m.darks) // (m.height if m.scan else 1)
    return total


class SimulatedSession:
    """The state of one simulation: cameras at work, panels, views."""

    def __init__(
        self, preset: Preset, models: dict[str, CameraModel], root: int, objects: int
    ) -> None:
        self.preset, self.models, self.root = preset, models, root
        self.names = [f"icon{i + 1}" for i in range(objects)]
        self.cameras = {
            name: SimulatedCamera(model, root, supersampling=preset.supersampling)
            for name, model in models.items()
        }
        self.panels = {name: self._panel(name) for name in self.names}
        self.views = {
            name: {
                frame: view for m in models.values() for frame, view in self._views(name, m).items()
            }
            for name in [*self.names, CHART]
        }
        self.done = self.total = 0

    def _rng(self, *names: str) -> np.random.Generator:
        return np.random.default_rng(key(self.root, *names))

    def _panel(self, name: str) -> Panel:
        rng, p = self._rng("panel", name), self.preset
        size = 1.0 if name == self.names[0] else float(rng.uniform(0.82, 1.0))
        return Panel(
            width_mm=round(421.0 * size, 1),
            height_mm=round(316.0 * size, 1),
            radius_mm=float(rng.uniform(*p.radius_mm)),
            depth_mm=float(rng.uniform(*p.depth_mm)),
            border_mm=round(34.0 * size, 1),
            bevel_mm=p.bevel_mm,
            twist_mm=float(rng.uniform(-1, 1) * p.twist_mm),
        )

    def _view(self, name: str, model: CameraModel) -> Viewpoint:
        """Place a camera once, and each object anew before it."""
        p, rng = self.preset, self._rng("place", model.name)
        turned = p.scanner_turn_deg if model.scan else 0.0
        tilt = rng.normal(0, p.tilt_deg, 2).clip(-1.6 * p.tilt_deg, 1.6 * p.tilt_deg)
        roll = float(np.clip(rng.normal(0, p.roll_deg), -1.6 * p.roll_deg, 1.6 * p.roll_deg))
        shift = rng.uniform(-p.shift_mm, p.shift_mm, 2)
        off = rng.uniform(-0.008, 0.008, 2) * model.width
        view = model.view(
            tilt_deg=(float(tilt[0]), float(tilt[1]), roll + turned),
            shift_mm=(float(shift[0]), float(shift[1])),
            centre_off=(float(off[0]), float(off[1])),
        )
        again = self._rng("lay", name, model.name)
        lay = turn(0.0, 0.0, float(again.normal(0, 0.3 * p.roll_deg)))
        moved = again.uniform(-0.4, 0.4, 2) * p.shift_mm
        return view.moved(lay, np.array([*moved, 0.0]))

    def _views(self, name: str, model: CameraModel) -> dict[str, Viewpoint]:
        """Return where a camera stands, by CAMERA, or by CAMERA#TILE where a stage moves it from tile to tile."""
        view, p = self._view(name, model), self.preset
        if model.whole is None:
            return {model.name: view}
        axes = turn(0.0, 0.0, float(self._rng("stage", model.name).normal(0, p.stage_turn_deg)))
        views = {}
        for tile, place in tile_places(model, p.overlap).items():
            rng = self._rng("stage", name, model.name, tile)
            lean = turn(*(float(v) for v in rng.normal(0, p.stage_deg, 3)))
            stop = axes @ (*place, 0.0) + rng.normal(0, p.stage_mm, 3) * (1.0, 1.0, 0.25)
            size, period, phase = view.wobble
            if model.scan:  # each pass by itself
                phase = float(self._rng("wobble", name, model.name, tile).uniform(0, 2 * np.pi))
            rotation, moved = lean @ np.reshape(view.rotation, (3, 3)), view.translation - stop
            views[f"{model.name}#{tile}"] = replace(
                view,
                rotation=tuple(float(v) for v in rotation.ravel()),
                translation=tuple(float(v) for v in moved),
                wobble=(size, period, phase),
            )
        return views

    def run(self, writer: FrameWriter, setups: Sequence[str]) -> Iterator[SimulationStep]:
        """Capture everything."""
        p = self.preset
        targets = len(self.names) + int(p.charts)
        self.total = sum(len(m.bands) * (targets * prod(m.tiles) + 2) for m in self.models.values())
        self.total += len(self.names)
        others = []
        for setup in setups:
            model = relit(self.models[SETUP_CAMERA], SETUPS[setup].illuminant)
            others.append(SimulatedCamera(model, self.root, setup, p.supersampling))
            self.total += len(model.bands) * (len(self.names) * prod(model.tiles) + 1)
        for camera in self.cameras.values():
            for target in ("dark", "white"):
                yield from self._take(writer, camera, target, None)
        for other in others:
            yield from self._take(writer, other, "white", None)
        for i, name in enumerate(self.names):
            painting = self.paint(name, i)
            self.done += 1
            yield SimulationStep(self.done, self.total, f"{name} painted", True)
            yield from self._capture(writer, name, self.panels[name], painting, others)
        if p.charts:
            chart = paint_chart(self._fineness())
            yield from self._capture(writer, CHART, chart_panel(), chart, [])

    def _fineness(self) -> float:
        """Samples of a painting per mm: 1.75 for a pixel of the finest camera, taking part or not."""
        finest = max(m.sampling for m in camera_models().values()) * self.preset.scale
        return max(self.preset.fineness, 1.75 * finest)

    def paint(self, name: str, index: int) -> Painting:
        """Paint one object."""
        panel, rng, lean = (
            self.panels[name],
            self._rng("painting", name),
            self.preset.unevenness_deg,
        )
        icon = paint_icon(panel, self._fineness(), rng, saints=index % 3 + 1)
        if lean:
            icon = make_uneven(icon, lean, self._rng("unevenness", name))
        if not self.preset.own_pigments or index == 0:
            return icon
        pigments = draw_pigments(self._rng("pigments", name))
        return replace(icon, spectra=paint_spectra(icon.names, WAVELENGTHS, pigments=pigments))

    def _capture(
        self,
        writer: FrameWriter,
        name: str,
        panel: Panel,
        painting: Painting,
        others: Sequence[SimulatedCamera],
    ) -> Iterator[SimulationStep]:
        # Finest first: each camera looks at the painting averaged to its own sampling.
        by_factor = {1: painting}
        for camera in self.cameras.values():
            factor = max(1, int(painting.px_per_mm / (2.2 * camera.model.sampling)))
            if factor not in by_factor:
                by_factor[factor] = painting.reduced(factor)
            reduced = by_factor[factor]
            for frame, view in self.views[name].items():
                camera_name, _, tile = frame.partition("#")
                if camera_name != camera.model.name:
                    continue
                target = f"{name}/{tile}" if tile else name
                lattice = tabulate(view, panel)
                sight = view_painting(camera.model, view, panel, reduced, lattice=lattice)
                yield from self._take(writer, camera, target, sight)
                for other in others:
                    if other.model.name == camera.model.name:
                        other_sight = view_painting(
                            other.model, view, panel, reduced, setup=other.setup, lattice=lattice
                        )
                        yield from self._take(writer, other, target, other_sight)

    def _take(
        self, writer: FrameWriter, camera: SimulatedCamera, target: str, sight: PaintingView | None
    ) -> Iterator[SimulationStep]:
        name, first = camera.model.name, self.done
        one_file_a_band = not KINDS[camera.model.kind].is_broad
        for frame in camera.shoot(target, sight, white=target == "white"):
            writer.add(camera, target, frame)
            if one_file_a_band and frame.shot == 0:
                self.done += 1
            yield SimulationStep(self.done, self.total, f"{target} {name} {frame.band}".rstrip())
        writer.finish(camera, target)
        self.done = first + len(camera.model.bands)
        yield SimulationStep(self.done, self.total, f"{target} {name}", True)

    def truth(self) -> SimulatedTruth:
        """Return the exact geometry of the campaign."""
        return SimulatedTruth(
            REFERENCE,
            self.panels,
            {
                frame: self.models[frame.partition("#")[0]].geometry()
                for frame in self.views[self.names[0]]
            },
            {name: self.views[name] for name in self.names},
        )


def tile_places(model: CameraModel, overlap: float) -> dict[str, tuple[float, float]]:
    """Return where the middles of a camera's tiles are, mm from the middle of all, x right and y down, by their names."""
    (rows, columns), (across, down) = model.tiles, model.step(overlap)
    return {
        f"r{i + 1}c{j + 1}": ((j - (columns - 1) / 2) * across, (i - (rows - 1) / 2) * down)
        for i in range(rows)
        for j in range(columns)
    }


WHITE_TABLE = "white_reflectance.csv"
FIRST_SHOT = {"dark": 0, "white": 100}


class FrameWriter:
    """Writes frames below raw/ of a folder; gathers the bands of a cube until it is whole."""

    def __init__(self, folder: Folder) -> None:
        self.folder = folder
        self.files = self.bytes = 0
        self.cubes: dict[str, np.ndarray] = {}

    def add(self, camera: SimulatedCamera, target: str, frame: SimulatedFrame) -> None:
        """Write one frame, or keep it for its cube."""
        bands_in = KINDS[camera.model.kind].bands_in
        if bands_in == "file":
            labels = [b.label for b in camera.model.bands]
            lines, samples = frame.counts.shape
            # Interleaved by line, as the scanner writes it.
            cube = self.cubes.setdefault(target, np.empty((lines, len(labels), samples), "<u2"))
            cube[:, labels.index(frame.band)] = frame.counts
            return
        if bands_in == "files":
            file = f"{frame.band.removesuffix(' nm')}nm_{frame.shot:02d}.tif"
        elif bands_in == "sensors":
            file = f"{frame.sensor}_{frame.shot:03d}.tif"
        else:
            file = f"DSC_{FIRST_SHOT.get(target, 1000) + frame.shot:04d}.tif"
        self._write(f"{_raw(camera)}/{target}/{file}", _tiff(frame.counts))

    def finish(self, camera: SimulatedCamera, target: str) -> None:
        """Write the cube of `target`, where the camera makes one."""
        cube = self.cubes.pop(target, None)
        if cube is not None:
            name = f"{_raw(camera)}/{target}"
            header = _envi_header(cube.shape[2], cube.shape[0], camera.model.bands)
            self._write(f"{name}.raw", cube.data)
            self._write(f"{name}.hdr", header.encode("ascii"))

    def _write(self, name: str, data: bytes | memoryview) -> None:
        self.folder.write_bytes(name, data)
        self.files += 1
        self.bytes += memoryview(data).nbytes


def _raw(camera: SimulatedCamera) -> str:
    return "/".join(part for part in ("raw", camera.setup, camera.model.name) if part)


def _tiff(counts: np.ndarray) -> bytes:
    import tifffile

    buffer = BytesIO()
    tifffile.imwrite(buffer, counts, photometric="minisblack", metadata=None)
    return buffer.getvalue()


def _envi_header(samples: int, lines: int, bands: tuple[BandModel, ...]) -> str:
    wavelengths = ", ".join(f"{b.centre:.1f}" for b in bands)
    return (
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {len(bands)}\nheader offset = 0\n"
        "file type = ENVI Standard\ndata type = 12\ninterleave = bil\nbyte order = 0\n"
        f"wavelength units = nm\nwavelength = {{{wavelengths}}}\n"
    )


def write_tables(folder: Folder, models: Mapping[str, CameraModel]) -> None:
    """Write the white board's reflectance and the sensitivities of broad-band cameras, as CSV."""
    grid = np.arange(380, 1021, 10)
    rows = [f"{w},{WHITE_REFLECTANCE}" for w in grid]
    _write_lines(folder, WHITE_TABLE, ["wavelength,white", *rows])
    for name, model in models.items():
        if KINDS[model.kind].is_broad:
            labels, table = response_table(model.bands)
            lines = [",".join(["wavelength", *labels])]
            for w, row in zip(WAVELENGTHS, table, strict=True):
                lines.append(",".join([f"{w:g}", *(f"{v:.5f}" for v in row)]))
            _write_lines(folder, f"{name}_sensitivity.csv", lines)


def write_positions(folder: Folder, models: Mapping[str, CameraModel], overlap: float) -> None:
    """Write where the stage of every camera of tiles was to stop, mm."""
    for name, model in models.items():
        if model.whole:
            rows = [f"{t},{x:.3f},{y:.3f}" for t, (x, y) in tile_places(model, overlap).items()]
            _write_lines(folder, f"{name}_stage.csv", ["tile,x,y", *rows])


def _write_lines(folder: Folder, name: str, lines: list[str]) -> None:
    folder.write_bytes(name, ("\n".join(lines) + "\n").encode())


def write_campaign_toml(
    folder: Folder,
    models: Mapping[str, CameraModel],
    panels: Mapping[str, Panel],
    *,
    chart: str | None,
    setups: Sequence[str],
) -> None:
    """Write campaign.toml."""
    parts = [
        '[campaign]\ntitle = "A simulated campaign"\ncreator = "levkas simulate"\n'
        'date = "2019"\nlicence = "CC0-1.0"\n'
        f'reference = {{ camera = "{REFERENCE[0]}", band = "{REFERENCE[1]}" }}\n'
    ]
    parts.append(
        "# Icons lie on their side before the cameras, as lamps at 70 degrees want it.\n"
        '[grid]\nrotate = 90\nregion = "auto"\n'
    )
    parts += [_camera_text(model) for model in models.values()]
    names = ", ".join(f'"{name}"' for name in panels)
    charts = f'charts = {{ {chart} = "ColorChecker24" }}\n' if chart else ""
    parts.append(
        f'[targets]\ndark = "dark"\nwhite = {{ names = "white", reflectance = "{WHITE_TABLE}" }}\n'
        f"{charts}objects = [{names}]\n"
    )
    for label in setups:
        parts.append(
            f"[setups.{label}.cameras.{SETUP_CAMERA}]\n"
            + _files(models[SETUP_CAMERA], f"raw/{label}/{SETUP_CAMERA}", "DSC_{shot}.tif")
        )
    for name, panel in panels.items():
        parts.append(
            f'[objects.{name}]\ntitle = "Simulated {name}"\nmedium = "egg tempera and gold on wood"\n'
            f"size_mm = [{panel.height_mm:g}, {panel.width_mm:g}]\n"
        )
    folder.write_bytes("campaign.toml", "\n".join(parts).encode())


def _camera_text(model: CameraModel) -> str:
    noise = model.sensors[0].noise
    levels = f"black = {noise.black:g}\nsaturation = {noise.saturation}\nbits = {noise.bits}\n"
    head = f'[cameras.{model.name}]\nkind = "{model.kind}"\n'
    raw = f"raw/{model.name}"
    bands_in = KINDS[model.kind].bands_in
    if model.whole:
        head += f'positions = "{model.name}_stage.csv"\n'
    if bands_in == "pattern":
        return (
            f'{head}{_files(model, raw, "DSC_{shot}.tif")}pattern = "{_pattern(model, 0)}"\n'
            f'sensitivity = "{model.name}_sensitivity.csv"\n{levels}'
        )
    if bands_in == "files":
        return f"{head}{_files(model, raw, '{wavelength}nm_{shot}.tif')}{_steps(model)}{levels}"
    if bands_in == "file":
        parts = f"{raw}/{{target}}/r{{row}}c{{column}}.hdr", f"{raw}/{{target}}.hdr"
        files = f'["{parts[0]}", "{parts[1]}"]' if model.whole else f'"{parts[1]}"'
        return f"{head}files = {files}\n{_steps(model)}{levels}"
    text = f'{head}sensitivity = "{model.name}_sensitivity.csv"\n{levels}'
    for i, sensor in enumerate(model.sensors):
        labels = ", ".join(f'"{model.bands[k].label}"' for k in sensor.bands)
        mosaic = f"pattern = {_rows(model, i)}\n" if sensor.pattern else ""
        text += (
            f'\n[[cameras.{model.name}.sensors]]\nname = "{sensor.name}"\n'
            f"{_files(model, raw, sensor.name + '_{shot}.tif')}{mosaic}bands = [{labels}]\n"
        )
    return text


def _files(model: CameraModel, raw: str, name: str) -> str:
    one = f'"{raw}/{{target}}/{name}"'
    tiled = f'"{raw}/{{target}}/r{{row}}c{{column}}/{name}"'
    return f"files = [{tiled}, {one}]\n" if model.whole else f"files = {one}\n"


def _pattern(model: CameraModel, sensor: int) -> str:
    chosen = model.sensors[sensor]
    return "".join(model.bands[chosen.bands[k]].label for row in chosen.pattern or () for k in row)


def _rows(model: CameraModel, sensor: int) -> str:
    chosen = model.sensors[sensor]
    rows = [
        ", ".join(f'"{model.bands[chosen.bands[k]].label}"' for k in row)
        for row in chosen.pattern or ()
    ]
    return "[" + ", ".join(f"[{row}]" for row in rows) + "]"


def _steps(model: CameraModel) -> str:
    waves = [b.centre for b in model.bands]
    step = waves[1] - waves[0]
    return f"wavelengths = {{ start = {waves[0]:g}, stop = {waves[-1]:g}, step = {step:g} }}\n"
