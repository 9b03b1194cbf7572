"""Files of a simulated campaign: frames as cameras hand them over, tables, campaign.toml."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO

import numpy as np

from levkas.core.files import Folder
from levkas.simulation.cameras import CameraModel
from levkas.simulation.capture import WHITE_REFLECTANCE, Camera, Frame
from levkas.simulation.panel import Panel
from levkas.simulation.pigments import WAVELENGTHS
from levkas.simulation.sensitivities import BandModel, response_table

WHITE_TABLE = "white_reflectance.csv"
FIRST_SHOT = {"dark": 0, "white": 100}


class FrameWriter:
    """Writes frames below raw/ of a folder; gathers the bands of a cube until it is whole."""

    def __init__(self, folder: Folder) -> None:
        self.folder = folder
        self.files = self.bytes = 0
        self.cubes: dict[str, np.ndarray] = {}

    def add(self, camera: Camera, target: str, frame: Frame) -> None:
        """Write one frame, or keep it for its cube."""
        kind = camera.model.kind
        if kind == "cube":
            labels = [b.label for b in camera.model.bands]
            lines, samples = frame.counts.shape
            # Interleaved by line, as the scanner writes it.
            cube = self.cubes.setdefault(target, np.empty((lines, len(labels), samples), "<u2"))
            cube[:, labels.index(frame.band)] = frame.counts
            return
        if kind == "bands":
            file = f"{frame.band.removesuffix(' nm')}nm_{frame.shot:02d}.tif"
        elif kind == "sensors":
            file = f"{frame.sensor}_{frame.shot:03d}.tif"
        else:
            file = f"DSC_{FIRST_SHOT.get(target, 1000) + frame.shot:04d}.tif"
        self._write(f"{_raw(camera)}/{target}/{file}", _tiff(frame.counts))

    def finish(self, camera: Camera, target: str) -> None:
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


def _raw(camera: Camera) -> str:
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
        if model.kind in ("mosaic", "sensors"):
            labels, table = response_table(model.bands)
            lines = [",".join(["wavelength", *labels])]
            for w, row in zip(WAVELENGTHS, table, strict=True):
                lines.append(",".join([f"{w:g}", *(f"{v:.5f}" for v in row)]))
            _write_lines(folder, f"{name}_sensitivity.csv", lines)


def _write_lines(folder: Folder, name: str, lines: list[str]) -> None:
    folder.write_bytes(name, ("\n".join(lines) + "\n").encode())


def write_campaign_toml(
    folder: Folder,
    models: Mapping[str, CameraModel],
    panels: Mapping[str, Panel],
    *,
    reference: tuple[str, str],
    chart: str | None,
    setup: tuple[str, str] | None,
    upright: bool,
) -> None:
    """Write campaign.toml."""
    parts = [
        '[campaign]\ntitle = "A simulated campaign"\ncreator = "levkas simulate"\n'
        'date = "2019"\nlicence = "CC0-1.0"\n'
        f'reference = {{ camera = "{reference[0]}", band = "{reference[1]}" }}\n'
    ]
    if upright:
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
    if setup:
        label, camera = setup
        parts.append(
            f"[setups.{label}.cameras.{camera}]\n"
            f'files = "raw/{label}/{camera}/{{target}}/DSC_{{shot}}.tif"\n'
        )
    for name, panel in panels.items():
        size = (panel.width_mm, panel.height_mm)
        shown = size[::-1] if upright else size
        parts.append(
            f'[objects.{name}]\ntitle = "Simulated {name}"\nmedium = "egg tempera and gold on wood"\n'
            f"size_mm = [{shown[0]:g}, {shown[1]:g}]\n"
        )
    folder.write_bytes("campaign.toml", "\n".join(parts).encode())


def _camera_text(model: CameraModel) -> str:
    noise = model.sensors[0].noise
    levels = f"black = {noise.black:g}\nsaturation = {noise.saturation}\nbits = {noise.bits}\n"
    head = f'[cameras.{model.name}]\nkind = "{model.kind}"\n'
    raw = f"raw/{model.name}"
    if model.kind == "mosaic":
        return (
            f'{head}files = "{raw}/{{target}}/DSC_{{shot}}.tif"\npattern = "{_pattern(model, 0)}"\n'
            f'sensitivity = "{model.name}_sensitivity.csv"\n{levels}'
        )
    if model.kind == "bands":
        return f'{head}files = "{raw}/{{target}}/{{wavelength}}nm_{{shot}}.tif"\n{_steps(model)}{levels}'
    if model.kind == "cube":
        return f'{head}files = "{raw}/{{target}}.hdr"\n{_steps(model)}{levels}'
    text = f'{head}sensitivity = "{model.name}_sensitivity.csv"\n{levels}'
    for i, sensor in enumerate(model.sensors):
        labels = ", ".join(f'"{model.bands[k].label}"' for k in sensor.bands)
        mosaic = f"pattern = {_rows(model, i)}\n" if sensor.pattern else ""
        text += (
            f'\n[[cameras.{model.name}.sensors]]\nname = "{sensor.name}"\n'
            f'files = "{raw}/{{target}}/{sensor.name}_{{shot}}.tif"\n{mosaic}bands = [{labels}]\n'
        )
    return text


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
