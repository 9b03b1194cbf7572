"""Small sound files of every kind that is read, for tests/fuzzing.py to spoil."""

import io
import json

import imagecodecs
import numpy as np
import tifffile

from levkas.registration.control_points import ControlPoints, format_points

CAMPAIGN = b"""[campaign]
title = "Two paintings"
date = 2024-05-31
reference = { camera = "vis", band = "550" }
[grid]
mirror = true
region = [0, 0, 40, 30]
[cameras.vis]
kind = "bands"
files = "vis/{target}/{wavelength}nm.tif"
wavelengths = { start = 400, stop = 720, step = 10 }
bits = 12
[cameras.msfa]
kind = "mosaic"
files = ["msfa/{target}_{shot}.tif"]
pattern = [["B1", "B2"], ["B3", "B4"]]
exposures = "merge"
[targets]
dark = "dark"
white = { names = ["white"], reflectance = 0.98 }
[objects.icon1]
size_mm = [300, 400]
"""
EDITS = b"""version = 1
[objects.icon1.cameras.d80]
deleted = [[1.5, 2.0, 3.25, 4.0]]
moved = [[1, 2, 3, 4, 1, 2, 3, 5]]
reject = 12.0
[objects.icon1.cameras."msbs:IR"]
added = [[10.0, 20.0, 30.0, 40.0]]
"""


def seeds():
    """Return (name of the file, its bytes, files beside it) of every kind."""
    codes = (np.arange(15 * 13, dtype=np.uint16) * 21).reshape(15, 13)
    for name, options in {
        "plain": {}, "deflate": {"compression": "zlib", "predictor": True}, "big": {"bigtiff": True},
        "lzw": {"compression": "lzw", "rowsperstrip": 4}, "tiles": {"tile": (16, 16)},
        "zstd": {"compression": "zstd"}, "order": {"byteorder": ">"},
        "tags": {"extratags": [(33434, "2I", 1, (1, 4), True), (34855, "H", 1, 100, True),
                (270, "s", 0, "a frame", True), (306, "s", 20, "2019:02:08 17:43:35", True),
                (272, "s", 0, "D80", True)]},
    }.items():  # fmt: skip
        stream = io.BytesIO()
        tifffile.imwrite(stream, codes, **options)
        yield f"{name}.tif", stream.getvalue(), {}
        if name == "tags":
            yield "shot.exif", stream.getvalue(), {}
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.stack([codes] * 3), photometric="minisblack", metadata=None)
    yield "pages.tif", stream.getvalue(), {}
    stream = io.BytesIO()
    tifffile.imwrite(stream, (codes >> 4).astype(np.uint8), compression="jpeg")
    yield "jpeg.tif", stream.getvalue(), {}
    yield "gray.png", bytes(imagecodecs.png_encode(codes)), {}
    yield "colour.png", bytes(imagecodecs.png_encode(np.dstack([codes >> 4] * 3).astype("u1"))), {}
    yield "photo.jpg", bytes(imagecodecs.jpeg8_encode((codes >> 4).astype(np.uint8))), {}
    header = (
        "ENVI\n; from a scanner\nsamples = 5\nlines = 4\nbands = 3\ndata type = 12\ninterleave = bil\n"
        "header offset = 0\nbyte order = 0\nwavelength units = nm\nwavelength = {400.1, 500,\n 600}\n"
        'band names = {"a", b, c}\nreflectance scale factor = 1\ndata ignore value = -1\n'
    )
    yield "scan.hdr", header.encode(), {"scan.raw": bytes(range(120))}
    yield "campaign.toml", CAMPAIGN, {}
    yield "edits.toml", EDITS, {}
    record = {"campaign": "x", "cameras": {"vis": {"bands": ["a"], "size": [1.5, 2e3]}}, "n": None}
    yield "record.json", json.dumps(record).encode(), {}
    yield from table_seeds()
    yield from point_seeds()


def table_seeds():
    """Return CSVs as `seeds` does."""
    yield "exposures.csv", b'file,exposure_s\r\na.tif,0.25\n"sub\\b.tif",1e-3\n', {}
    yield "spectrum.csv", b"# a board\nwavelength,share\n380,0.9\n580,95\n780.5,.97\n", {}
    yield "sensitivity.csv", b"nm,B1,B2,B3\n400,0,1,.5\n500,1,0,\n600,.5,0,1e-3\n", {}
    yield "light.csv", b"wavelength,lamp\n400,0.5\n500,1\n700,0.25\n", {}
    head = ",".join(f"{column}:{row}" for row in "12" for column in "AB")
    yield "chart.csv", f"nm,{head}\n400,1,2,3,4\n500,5,60,7,8\n".encode(), {}


def point_seeds():
    """Return control points in every dialect that is read, as `seeds` does."""
    points = ControlPoints([[0, 0.5], [30.25, 7]], [[1, 2], [28, 9]], enabled=[True, False])
    yield "levkas.points.csv", format_points(points), {}
    yield "bigwarp.points.csv", b'"eye","true","1.0","2.0","0.0","0.5"\n', {}
    qgis = b"#CRS: \nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n1,-1,5.5,-1.5,1,0,0,0\n"
    yield "qgis.points.points", qgis, {}
    frames = (
        b"object,camera,band,reference_x,reference_y,x,y\nicon,d80,R,1,2,3,4\nicon,d80,,5,6,7,8\n"
    )
    yield "frames.csv", frames, {}
