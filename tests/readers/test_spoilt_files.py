"""Small files of every kind, as they are and with bytes spoilt: a sound value or a refusal of ours, and nothing else."""

import io
import json
from math import inf

import imagecodecs
import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.file_index import read_exposures
from levkas.campaign.edits import read_edits
from levkas.core.problems import Refused
from levkas.core.text import read_json, read_text
from levkas.planning.spectra import read_table
from levkas.quality.targets.charts import Chart, parse_reference
from levkas.readers.envi import open_envi
from levkas.readers.frames import read_facts, read_frame
from levkas.registration.control_points import (
    ControlPoints,
    format_points,
    is_table_of_frames,
    read_points,
    read_table_of_frames,
)
from levkas.stages.spectra import read_certificate, read_sensitivity

CHART = Chart("two by two", 2, 2, (0, 1, 2, 3))
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
        "deflate": {"compression": "zlib", "predictor": True}, "big": {"bigtiff": True, "byteorder": ">"},
        "tiles": {"tile": (16, 16)},
        "tags": {"extratags": [(33434, "2I", 1, (1, 4), True), (34855, "H", 1, 100, True),
                (270, "s", 0, "a frame", True), (306, "s", 20, "2019:02:08 17:43:35", True),
                (272, "s", 0, "D80", True)]},
    }.items():  # fmt: skip
        stream = io.BytesIO()
        tifffile.imwrite(stream, codes, **options)
        yield f"{name}.tif", stream.getvalue(), {}
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
    qgis = b"#CRS: \nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n1,-1,5.5,-1.5,1,0,0,0\n"
    yield "qgis.points.points", qgis, {}
    frames = (
        b"object,camera,band,reference_x,reference_y,x,y\nicon,d80,R,1,2,3,4\nicon,d80,,5,6,7,8\n"
    )
    yield "frames.csv", frames, {}


# --- how each is read, and what must hold of what was read ---------------------------------------


def finite(values, low=-inf):
    values = np.asarray(values, float)
    assert np.isfinite(values).all() and (values >= low).all()


def picture(path):
    """Facts, values and file must agree."""
    facts, values = read_facts(path), read_frame(path)
    assert values.shape == facts.shape and values.dtype.name == facts.dtype
    assert values.size and values.dtype.isnative and values.flags.writeable
    levels = (facts.black, facts.saturation, facts.exposure_s, facts.iso)
    finite([level for level in levels if level is not None], 0)
    finite(facts.wavelengths or (), 0)


def scan(path):
    opened, values = open_envi(path), read_frame(path)
    last = opened.facts.shape[0] - 1
    assert opened.read_lines(last, last + 1).tobytes() == values[last:].tobytes()
    picture(path)


def corrections(path):
    for edits in read_edits(path).frames.values():
        for pairs in edits.pairs().values():
            finite(pairs)


def record(path):
    assert read_json(path) == json.loads(path.read_text("utf-8-sig"))


def pairs_of(path):
    several = is_table_of_frames(path)
    for points in read_table_of_frames(path).values() if several else [read_points(path)]:
        finite([points.reference, points.target])
        assert points.reference.shape == points.target.shape == (len(points), 2)


def table(path):
    """Read a table by what its name says it is."""
    if path.stem == "exposures":
        finite(list(read_exposures(path).values()), 0)
        return
    if path.stem == "chart":
        reference = parse_reference(read_text(path, "a CSV"), CHART, file=str(path))
        wavelengths, values = reference.wavelengths, reference.spectra.T
    elif path.stem == "sensitivity":
        wavelengths, values = read_sensitivity(path, ["B1", "B2", "B3"])
    elif path.stem == "light":
        wavelengths, values, _ = read_table(path, field="spectrum", file=str(path))
    else:
        wavelengths, values, _ = read_certificate(path)
    finite(values)
    finite(wavelengths, 0)
    assert len(wavelengths) == len(values) > 1 and (np.diff(wavelengths) > 0).all()


READ = {
    "points.csv": pairs_of, "points": pairs_of, "frames.csv": pairs_of, "campaign.toml": load_campaign,
    "edits.toml": corrections, "hdr": scan, "json": record, "csv": table,
}  # fmt: skip
"""By how names end, the more special ones first; all others are pictures."""
FILES = {name: (data, beside) for name, data, beside in seeds()}


def read(path):
    """Read a file; return whether it was refused. Whatever else it raises is a failure."""
    try:
        next((one for end, one in READ.items() if path.name.endswith(end)), picture)(path)
    except Refused as refused:
        assert refused.problems and all(problem.code for problem in refused.problems)
        return True
    return False


def laid(folder, name, data=None):
    own, beside = FILES[name]
    for other, content in {**beside, name: data or own}.items():
        (folder / other).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_small_files_of_every_kind_are_read_as_what_they_are(tmp_path, name):
    assert not read(laid(tmp_path, name))


@pytest.mark.parametrize("count", [12, pytest.param(400, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("name", FILES)
def test_a_spoilt_file_gives_a_sound_value_or_our_refusal(tmp_path, name, count):
    rng, own = np.random.default_rng(len(name)), FILES[name][0]
    for _ in range(count):
        data = bytearray(own)
        for place in rng.integers(len(data), size=rng.integers(1, 7)):
            data[place if rng.random() < 0.5 else place % 200] = rng.integers(256)
        keep = len(data) if rng.random() < 0.7 else rng.integers(1, len(data))
        read(laid(tmp_path, name, bytes(data[:keep])))


# --- tables that look sound and are not -----------------------------------------------------------


def sensitivity(path):
    return read_sensitivity(path, ["B1", "B2"])


def chart(path):
    return parse_reference(path.read_bytes().decode(), CHART, file=str(path))


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (sensitivity, "nm,B1,B2\n400,0,1\n500,1,0\n500,1,1\n"),  # 500 nm twice
        (sensitivity, "nm,B1,B2\n400,0,1\n,1,0\n"),  # no wavelength
        (sensitivity, "nm,x,y,B1,B2\n400,0,1,2\n500,1,0,3\n"),  # more headings than columns
        (read_certificate, "400,0.9\n600,0.5\n600,0.7\n"),
        (chart, "nm,A1,B1,A2,B2\n400,1,2,3,4\n400,5,6,7,8\n"),
        (chart, "nm,A1\x0cB1\n#\x01\rA2,B2\r\r,1,2,3,4\n400,5"),
    ],
)
def test_a_table_that_says_no_value_or_two_of_one_place_is_refused(tmp_path, read, text):
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode())
    with pytest.raises(Refused):
        read(path)
