"""Layered TIFF for Photoshop, Affinity and Krita: the pictures of all cameras of an object, registered, one above the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.core.problems import Problem
from levkas.publish.export.layer import ExportLayer, ExportRefused, missing_library

MOST_BYTES = 2_000_000_000
"""Of all pictures of an object: a TIFF that is no BigTIFF holds 4 GB, and layers stand in it beside their sum."""


def write_photoshop(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write nothing yet: `finish` writes a file an object."""
    return []


def finish(layers: Sequence[ExportLayer], folder: Path) -> list[Path]:
    """Write OBJECT_layers.tif: the published pictures of its cameras, sRGB, 8 bits, each a layer with the camera's name.

    The lowest layer alone is visible. Where a camera saw nothing its layer is transparent.

    Raises
    ------
    ExportRefused
        Where psdtags is not installed (extra ``export``), a picture is missing or all are too large.
    """
    names = dict.fromkeys(layer.object for layer in layers)
    return [_write([one for one in layers if one.object == name], folder) for name in names]


def _write(layers: Sequence[ExportLayer], folder: Path) -> Path:
    try:
        import psdtags as psd
    except ImportError:
        raise missing_library("psdtags") from None
    import tifffile

    from levkas.colour.srgb import srgb_profile

    pictures = [_picture(layer) for layer in layers]
    if sum(picture.nbytes for picture in pictures) > MOST_BYTES:
        raise ExportRefused(
            Problem(
                "E_SIZE",
                f"the pictures of {layers[0].object} are too large for one layered TIFF",
                found=f"{sum(p.nbytes for p in pictures) / 1e9:.1f} GB",
                expected=f"at most {MOST_BYTES / 1e9:.0f} GB",
                fix="Choose some cameras with --camera.",
            )
        )
    made = [
        _layer_of(psd, layer, picture, hidden=at > 0)
        for at, (layer, picture) in enumerate(zip(layers, pictures, strict=True))
    ]
    source = psd.TiffImageSourceData(
        name=layers[0].object,
        psdformat=psd.PsdFormat.LE32BIT,
        layers=psd.PsdLayers(key=psd.PsdKey.LAYER, has_transparency=False, layers=made),
        usermask=psd.PsdUserMask(
            colorspace=psd.PsdColorSpaceType.RGB, components=(65535, 0, 0, 0), opacity=50
        ),
        info=[],
    )
    path = folder / f"{layers[0].object}_layers.tif"
    scale = layers[0].px_per_mm
    sampling: dict[str, Any] = (
        {"resolution": (10 * scale, 10 * scale), "resolutionunit": "centimeter"} if scale else {}
    )
    with replacing(path) as handle:
        tifffile.imwrite(
            handle, np.ascontiguousarray(pictures[0][..., :3]), byteorder="<", photometric="rgb", metadata=None,
            compression="zlib", software="Levkas", iccprofile=srgb_profile(),
            extratags=[source.tifftag(maxworkers=1)], **sampling,
        )  # fmt: skip
    return path


def _layer_of(psd: Any, layer: ExportLayer, picture: np.ndarray, *, hidden: bool) -> Any:
    name = f"{layer.camera} {layer.setup}".strip()
    height, width = picture.shape[:2]
    channels = (psd.PsdChannelId.TRANSPARENCY_MASK, *(psd.PsdChannelId(n) for n in range(3)))
    # The bit that the format calls "visible" hides a layer where it is set.
    flags = psd.PsdLayerFlag.PHOTOSHOP5 | psd.PsdLayerFlag(2 * hidden)
    return psd.PsdLayer(
        name=name,
        channels=[
            psd.PsdChannel(
                channelid=channel,
                compression=psd.PsdCompressionType.ZIP_PREDICTED,
                data=np.ascontiguousarray(picture[..., number]),
            )
            for channel, number in zip(channels, (3, 0, 1, 2), strict=True)
        ],
        mask=psd.PsdLayerMask(),
        rectangle=psd.PsdRectangle(0, 0, height, width),
        flags=flags,
        info=[psd.PsdString(psd.PsdKey.UNICODE_LAYER_NAME, name)],
    )


def _picture(layer: ExportLayer) -> np.ndarray:
    """Return the published picture of a layer with its coverage, (height, width, 4) uint8."""
    from PIL import Image

    file = layer.path.with_suffix(".png")
    if not file.is_file():
        raise ExportRefused(
            Problem("E_MISSING", f"{layer.stem} has no picture", str(file), fix="Build it again.")
        )
    with Image.open(file) as opened:
        pixels = np.asarray(opened.convert("RGB"))
    known = next(layer.planes())
    return np.dstack([pixels, np.where(np.isfinite(known), 255, 0).astype(np.uint8)])
