"""The spectral recovery challenges (NTIRE): MAT-files of version 7.3, pictures, and lists of names.

Their loaders read ``cube`` with h5py as (bands, width, height), pair ``Train_Spec/NAME.mat`` with
``Train_RGB/NAME.jpg``, and take the names of ``split_txt/train_list.txt`` and ``valid_list.txt``.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from levkas.core.files import replacing, write_bytes, write_text
from levkas.publish.export.layer import ExportLayer, missing_library
from levkas.publish.viewer.pyramid import encode_jpeg

QUALITY = 95
USER_BLOCK = 512
"""MATLAB's own header precedes the HDF5 file."""
MATLAB = b"MATLAB 7.3 MAT-file, written by levkas"
LISTS = {"train": "train_list.txt", "validation": "valid_list.txt", "test": "test_list.txt"}


def write_ntire(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write CAMERA/Train_Spec/STEM.mat and CAMERA/Train_RGB/STEM.jpg.

    ``cube`` is single, as MATLAB sees it (height, width, bands), ``bands`` (1, bands) the centres in nm
    or 1, 2, 3 …, ``norm_factor`` 1. What the camera did not see, NaN in the database, is 0: the
    loaders know no NaN.

    Raises
    ------
    ExportRefused
        Where h5py is not installed (extra ``export``).
    """
    home = _home(layer, folder)
    spectra, picture = home / "Train_Spec", home / "Train_RGB"
    path = spectra / f"{layer.stem}.mat"
    _write_mat73(layer, path)
    shown = picture / f"{layer.stem}.jpg"
    write_bytes(shown, _encode_jpeg(layer))
    return [path, shown]


def finish(layers: Iterable[ExportLayer], folder: Path) -> list[Path]:
    """Write the lists of names, by the splits that the database publishes."""
    from levkas.database.splits import split_objects

    layers = list(layers)
    splits = split_objects({layer.object for layer in layers})
    written = []
    for home in sorted({_home(layer, folder) for layer in layers}):
        mine = [layer for layer in layers if _home(layer, folder) == home]
        for split, name in LISTS.items():
            path = home / "split_txt" / name
            names = [layer.stem for layer in mine if splits[layer.object] == split]
            write_text(path, "".join(f"{stem}\n" for stem in names))
            written.append(path)
    return written


def _home(layer: ExportLayer, folder: Path) -> Path:
    return folder / "@".join(part for part in (layer.camera, layer.setup) if part)


def _write_mat73(layer: ExportLayer, path: Path) -> None:
    """Write a MAT-file of version 7.3: HDF5 behind MATLAB's header, dimensions MATLAB's reversed."""
    try:
        import h5py
    except ImportError:
        raise missing_library("h5py") from None
    height, width, count = layer.shape
    centres = layer.wavelengths or list(range(1, count + 1))
    with replacing(path) as handle:
        with h5py.File(handle, "w", userblock_size=USER_BLOCK) as mat:
            cube = mat.create_dataset("cube", (count, width, height), np.float32)
            for index, plane in enumerate(layer.planes()):
                cube[index] = np.where(np.isfinite(plane), plane, np.float32(0)).T
            cube.attrs["MATLAB_class"] = np.bytes_("single")
            for name, numbers in (("bands", centres), ("norm_factor", [1.0])):
                column = mat.create_dataset(name, data=np.array(numbers, np.float64)[:, None])
                column.attrs["MATLAB_class"] = np.bytes_("double")
        handle.seek(0)
        handle.write(MATLAB.ljust(116) + bytes(8) + b"\x00\x02IM")


def _encode_jpeg(layer: ExportLayer) -> bytes:
    from levkas.database.tiff_pages import open_pages

    picture = open_pages(layer.path).read_render()
    if picture is None:
        height, width, _ = layer.shape
        picture = np.zeros((height, width, 3), np.uint8)
    return encode_jpeg(picture, quality=QUALITY)
