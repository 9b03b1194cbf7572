"""Hostile files through every command that reads them: seconds, memory and outcome of each.

    python benchmarks/hostile.py --demo DEMO [--json OUT]

Each command runs in a process of its own, forked after the imports, with 1 GB of memory to take on top of
them (RLIMIT_DATA) and 60 s. DEMO is a demonstration that was built (`levkas demo DEMO`); its database is copied with
links, one file is replaced, and every command that reads databases is asked. Without it these rows are left out.
"""

import argparse
import io
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections import defaultdict
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace

# Processes are forked: no other thread may hold a lock then.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LEVKAS_THREADS": "1"}
TESTS = Path(__file__).resolve().parents[1] / "tests"
MEMORY = 1 << 30
PATIENCE_S = 60
FRAMES = (
    ("look", "{folder}"),
    ("radiometry", "{folder}"),
    ("plan", "exposure", "{file}", "--bits", "12"),
    ("chart", "{file}"),
    ("status", "{campaign}"),
    ("build", "{campaign}"),
    ("radiometry", "{campaign}"),
)
TEXTS = (("status", "{campaign}"), ("build", "{campaign}"), ("radiometry", "{campaign}"),
         ("chart", "{campaign}"), ("inspect", "{campaign}", "--no-open"))  # fmt: skip
POINTS = (("points", "convert", "{file}", "{folder}/out.csv"),)
DATABASES = (
    ("validate", "{file}"),
    ("export", "{file}", "--for", "envi", "-o", "{folder}/exported"),
    ("map", "{file}", "icon1", "{folder}/points.csv", "--from", "d80"),
    ("evaluate", "{file}"),
    ("chart", "{file}", "--object", "icon1", "--camera", "d80"),
    ("publish", "{file}", "-o", "{folder}/published"),
    ("status", "{demo}"),
    ("open", "{file}"),
    ("validate", "{file}", "without a manifest"),
)
OPENED_BY = {
    "provenance.json": ("validate", "status"),
    "registration/": ("validate", "map", "evaluate", "open"),
    "zarr/": ("validate", "open"),
    "camera.json": ("validate", "status"),
    "object.toml": ("validate", "status"),
    "database.toml": ("validate", "status"),
    "manifest": ("validate", "publish", "status"),
    "flags.tif": ("validate", "export", "chart", "open"),
    "sigma.tif": ("validate", "export", "open"),
    "_d80.tif": ("validate", "export", "chart", "evaluate", "open"),
    "catalogue.csv": ("validate", "export", "chart", "evaluate", "publish", "status", "open"),
}
"""Commands that open a file of a database, by a part of its name."""
GROUPS = ("frames", "campaigns", "points", "databases")
CAMPAIGN = """
[campaign]
reference = { camera = "vis", band = "a" }
[cameras.vis]
kind = "KIND"
files = "icon{target}SUFFIX"
[targets]
objects = ["1"]
"""


def frame_files(folder):
    """Yield (name, file) of hostile frames: those of the readers' test, and large ones that decode."""
    import numpy as np
    import tifffile

    sys.path[:0] = [str(TESTS / "readers"), str(TESTS)]
    from test_bombs import CASES, chunk
    from test_hostile_commands import page_of_zeros

    for name, (make, _, _, _, read) in CASES.items():
        if read == "frame":
            place = folder / name
            place.mkdir()
            yield name, Path(make(place))
    for name, side, compression, bits, strips in (
        ("20,000 x 20,000 zeros, deflate", 20_000, 8, 16, True),
        ("20,000 x 20,000 zeros, one strip", 20_000, 8, 8, False),
        ("20,000 x 20,000 zeros, PackBits", 20_000, 32773, 8, True),
        ("40,000 x 40,000 zeros, deflate", 40_000, 8, 8, True),
        ("5700 x 5700 zeros, deflate", 5700, 8, 16, True),
    ):
        place = folder / name
        place.mkdir()
        yield name, page_of_zeros(place / "icon1.tif", side, compression=compression, bits=bits, strips=strips)  # fmt: skip
    for name, options in (
        ("LZW zeros", {"compression": "lzw"}),
        ("tiled zeros", {"compression": "zlib", "tile": (512, 512)}),
    ):
        place = folder / name
        place.mkdir()
        tifffile.imwrite(place / "icon1.tif", np.zeros((8000, 8000), np.uint16), metadata=None, **options)  # fmt: skip
        yield name, place / "icon1.tif"
    place = folder / "4000 pages"
    place.mkdir()
    with tifffile.TiffWriter(place / "icon1.tif") as tiff:
        for _ in range(4000):
            tiff.write(np.zeros((8, 8), np.uint16), metadata=None, photometric="minisblack")
    yield place.name, place / "icon1.tif"
    place = folder / "PNG of 20,000 x 20,000 zeros"
    place.mkdir()
    squeezer = zlib.compressobj(9)
    rows = b"".join(squeezer.compress(bytes(20_001 * 100)) for _ in range(200)) + squeezer.flush()
    head = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 0, 0, 0, 0)
    (place / "icon1.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )
    yield place.name, place / "icon1.png"
    place = folder / "ENVI of terabytes"
    place.mkdir()
    header = "ENVI\nsamples = 400000\nlines = 400000\nbands = 16\ndata type = 5\ninterleave = bil\n"
    (place / "icon1.hdr").write_text(header)
    (place / "icon1.raw").write_bytes(bytes(4096))
    yield place.name, place / "icon1.hdr"
    place = folder / "ENVI of 8 GB that take no room"
    place.mkdir()
    header = "ENVI\nsamples = 4000\nlines = 1000\nbands = 250\ndata type = 5\ninterleave = bil\n"
    (place / "icon1.hdr").write_text(header)
    with (place / "icon1.raw").open("wb") as file:
        file.truncate(4000 * 1000 * 250 * 8)
    yield place.name, place / "icon1.hdr"
    place = folder / "empty file"
    place.mkdir()
    (place / "icon1.tif").write_bytes(b"")
    yield place.name, place / "icon1.tif"
    place = folder / "folder named like a frame"
    (place / "icon1.tif").mkdir(parents=True)
    yield place.name, place / "icon1.tif"
    place = folder / "pipe"
    place.mkdir()
    os.mkfifo(place / "icon1.tif")
    yield place.name, place / "icon1.tif"
    place = folder / "zip"
    place.mkdir()
    (place / "icon1.tif").write_bytes(b"PK\x03\x04" + bytes(1000))
    yield place.name, place / "icon1.tif"
    for name, text in (("line end in the name", b"icon1\n2.tif"), ("name that is no text", b"icon1\xff\xfe.tif")):  # fmt: skip
        place = folder / name
        place.mkdir()
        target = place / os.fsdecode(text)
        tifffile.imwrite(io.BytesIO(), np.zeros((4, 4)))
        target.write_bytes(page_of_zeros(folder / "small.tif", 100, compression=8, strips=False).read_bytes())  # fmt: skip
        yield name, target


def text_files():
    """Yield (name, text) of campaign.toml."""
    sys.path[:0] = [str(TESTS)]
    from test_hostile_commands import MONSTERS, filled

    for name, (line, keys) in MONSTERS.items():
        for size in (1 << 20, 400_000):
            yield f"campaign of {size // 1000} kB: {name}", filled(line, size - 500, **keys)


def point_files():
    """Yield (name of file, bytes) of control points."""
    yield "columns.csv", b"reference_x,reference_y,target_x,target_y\n" + b"1,2,3,4\n" * 1_900_000
    yield "commas.csv", b"," * (15 << 20)
    yield "quotes.csv", b'"' * (15 << 20)
    yield "line ends.csv", b"\n" * (15 << 20)
    yield "brackets.json", b"[" * (15 << 20)
    yield "pairs.json", b'{"a":[' + b"[]," * (5 << 20) + b"[]]}"
    yield "zeros.mat", bytes(15 << 20)
    yield "hugin.pto", b"c n0 N1 x1 y1 X1 Y1 t0\n" * 600_000
    yield "digits.csv", b"reference_x,reference_y,target_x,target_y\n" + b"9" * (15 << 20)


ODD = {
    "object": "../../..",
    "camera": 7,
    "reference": [],
    "grid": 3,
    "grid/size": [1e9, 1e9],
    "verdict": "accept",
    "bands": [1],
    "bands/R": 1,
    "bands/R/size": "large",
    "bands/G/size": [],
    "bands/G/transform": {"kind": "affine", "matrix": "x"},
    "bands/G/transform/kind": "magic",
    "bands/G/transform/steps": [],
}
"""Places in a registration record, and what stands there instead."""


def changed(place, value):
    """Return a maker of a JSON record in which one part is replaced."""

    def make(path, old):
        record = json.loads(old)
        *above, last = place.split("/")
        part = record
        for name in above:
            part = part[name]
        part[last] = value
        path.write_text(json.dumps(record))

    make.takes_old = True
    return make


def linked_out(path, old):
    """Put a link there, to the same bytes outside."""
    outside = path.parents[len(path.parts) - path.parts.index("database")] / f"outside-{path.name}"
    outside.write_bytes(old)
    path.symlink_to(outside)


linked_out.takes_old = True


def deep(path, old):
    """Leave the file, and nest folders beside it."""
    path.write_bytes(old)
    before = Path.cwd()
    os.chdir(path.parent)
    for _ in range(900):
        os.mkdir("d")  # noqa: PTH102
        os.chdir("d")
    os.chdir(before)


deep.takes_old = True


def damages():
    """Yield (name, file of the database, its new bytes, or what makes it)."""

    def bomb(path):
        from test_hostile_commands import page_of_zeros

        page_of_zeros(path, 20_000, compression=8)

    json_bombs = {
        "brackets": b"[" * (15 << 20),
        "pairs": b'{"a":[' + b"[]," * (5 << 20) + b"[]]}",
        "digits": b'{"shape":' + b"9" * (10 << 20) + b"}",
        "nothing": b"",
        "a list": b"[1]",
        "a table of nothing": b"{}",
    }
    for name, data in json_bombs.items():
        for file in ("objects/icon1/provenance.json", "objects/icon1/registration/d80.json", "zarr/icon1.zarr/zarr.json", "zarr/icon1.zarr/d80/values/zarr.json", "zarr/icon1.zarr/d80/band/zarr.json", "cameras/d80/camera.json"):  # fmt: skip
            yield f"{file}: {name}", file, data
    csv = {
        "catalogue.csv: lines": b"object,camera\n" + b"a,b\n" * (3 << 20),
        "catalogue.csv: quotes": b'"' * (15 << 20),
        "catalogue.csv: commas": b"," * (15 << 20),
        "catalogue.csv: nothing": b"",
        "catalogue.csv: no text": b"\xff\xfe" * 1000,
        "manifest-sha256.txt: lines": (b"0" * 64 + b"  a\n") * 200_000,
        "manifest-sha256.txt: names that lead out": b"0" * 64 + b"  ../../../etc/passwd\n",
        "manifest-sha256.txt: one line": b"0" * (15 << 20),
        "database.toml: keys": b"".join(b"k%d=1\n" % i for i in range(100_000)),
        "objects/icon1/object.toml: keys": b"".join(b"k%d=1\n" % i for i in range(100_000)),
        "objects/icon1/object.toml: brackets": b"x=" + b"[" * 900_000,
    }
    for name, data in csv.items():
        yield name, name.partition(":")[0], data
    yield "icon1_d80.tif: 20,000 x 20,000 zeros", "objects/icon1/icon1_d80.tif", bomb
    yield "icon1_d80.flags.tif: 20,000 x 20,000 zeros", "objects/icon1/icon1_d80.flags.tif", bomb
    yield "icon1_d80.sigma.tif: 20,000 x 20,000 zeros", "objects/icon1/icon1_d80.sigma.tif", bomb
    for file in ("catalogue.csv", "objects/icon1/icon1_d80.tif", "objects/icon1/icon1_d80.flags.tif",
                 "objects/icon1/registration/d80.json", "objects/icon1/object.toml", "zarr/icon1.zarr/d80/values/zarr.json"):  # fmt: skip
        yield f"{file}: a link that leads out", file, linked_out
    for place, value in ODD.items():
        yield f"d80.json: {place} = {json.dumps(value)}", "objects/icon1/registration/d80.json", changed(place, value)  # fmt: skip
    for name in ("values", "band"):
        for key in ("shape", "chunk_grid/configuration/chunk_shape"):
            file = f"zarr/icon1.zarr/d80/{name}/zarr.json"
            yield f"{file}: {key} of billions", file, changed(key, [10**9] * (3 if name == "values" else 1))  # fmt: skip
    yield "values: folders 900 levels deep", "zarr/icon1.zarr/d80/values/zarr.json", deep
    yield "icon1_d80.tif: a pipe", "objects/icon1/icon1_d80.tif", os.mkfifo
    yield "icon1_d80.tif: a folder", "objects/icon1/icon1_d80.tif", os.mkdir
    yield "catalogue.csv: a pipe", "catalogue.csv", os.mkfifo
    yield "catalogue.csv: a folder", "catalogue.csv", os.mkdir
    yield "manifest-sha256.txt: a pipe", "manifest-sha256.txt", os.mkfifo


def run(arguments):
    """Return what came of one command: outcome, seconds of processor time, bytes at the peak."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _in_child(arguments, writer)
    os.close(writer)
    data, before = b"", time.monotonic()
    signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    patience = 3 if arguments[0] == "inspect" else PATIENCE_S
    signal.alarm(patience)
    while piece := os.read(reader, 1 << 16):
        data += piece
    os.waitpid(child, 0)
    signal.alarm(0)
    os.close(reader)
    if data:
        return json.loads(data)
    outcome = (
        "served" if arguments[0] == "inspect" else f"ended after {time.monotonic() - before:.0f} s"
    )
    return {"outcome": outcome, "seconds": 0.0, "bytes": 0, "said": ""}


def _in_child(arguments, writer):
    from typer.testing import CliRunner

    from levkas.cli import app

    base = peak()
    held = int(next(row.split()[1] for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmData"))) << 10  # fmt: skip
    resource.setrlimit(resource.RLIMIT_DATA, (held + MEMORY, held + MEMORY))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    before = time.process_time()
    if arguments[-1] == "without a manifest":
        *arguments, _ = arguments
        (Path(arguments[1]) / "manifest-sha256.txt").unlink(missing_ok=True)
    if arguments[0] == "open":
        result = opened(arguments[1])
    else:
        result = CliRunner().invoke(app, [str(a) for a in arguments])
    seconds = time.process_time() - before
    error = result.exception
    outcome = {0: "done", 1: "refused", 2: "wrong option"}.get(result.exit_code, "?")
    said = result.output[:200]
    if error is not None and not isinstance(error, SystemExit):
        outcome = "TRACEBACK"
        said = "".join(traceback.format_exception(error))[-900:]
    told = {"outcome": outcome, "seconds": seconds, "bytes": max(0, peak() - base), "said": said}
    os.write(writer, json.dumps(told).encode())
    os._exit(0)


def opened(database):
    """Open a database and read a spectrum of a layer, its flags and its sigma; as a command would say it."""
    import levkas
    from levkas.core.problems import Refused

    status, said, error = 0, "", None
    try:
        layer = levkas.open(database)["icon1"]["d80"]
        for array in (layer, layer.flags, layer.sigma):
            if array is not None:
                array[10, 10].values  # noqa: B018
        levkas.open(database)["icon1"].position_sigma("d80")
    except (Refused, KeyError) as refused:
        status, said = 1, str(refused)
    except Exception as other:
        status, error = 1, other
    return SimpleNamespace(exit_code=status, output=said, exception=error)


def peak():
    """Return the peak of resident bytes."""
    rows = Path("/proc/self/status").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith("VmHWM")) << 10


def linked_demo(demo, place, file, content):
    """Return a copy of a demonstration's campaign in which one file of the database is replaced."""
    shutil.copytree(demo / "database", place / "database", copy_function=os.link)
    shutil.copytree(demo / "raw", place / "raw", copy_function=os.link)
    for path in demo.glob("*.*"):
        if path.is_file():
            shutil.copy(path, place)
    found = sorted((place / "database").rglob(file.lstrip("*/"))) if file.startswith("*") else [place / "database" / file]  # fmt: skip
    if not found or not found[0].exists():
        return None
    old = found[0].read_bytes()
    found[0].unlink()
    if hasattr(content, "takes_old"):
        content(found[0], old)
    elif isinstance(content, bytes):
        found[0].write_bytes(content)
    else:
        content(found[0])
    return place


def cases(root, demo, groups, only):
    """Yield (group, name of file, command, arguments)."""
    for name, file in frame_files(root / "frames") if "frames" in groups else ():
        suffix = file.suffix
        campaign = root / "campaigns" / name
        campaign.mkdir(parents=True)
        link = campaign / f"icon1{suffix}"
        for beside in file.parent.glob(f"{file.stem}*") if file.name.isascii() and "\n" not in file.name else [file]:  # fmt: skip
            (campaign / (f"icon1{beside.suffix}" if beside != file else link.name)).symlink_to(
                beside
            )
        kind = "cube" if suffix == ".hdr" else "image" if suffix in (".jpg", ".png") else "mosaic"
        text = CAMPAIGN.replace("KIND", kind).replace("SUFFIX", suffix)
        text += 'dark = "0"\n' if kind != "image" else ""
        (campaign / "campaign.toml").write_text(text)
        for command in FRAMES:
            yield "frames", name, command, {"folder": file.parent, "file": file, "campaign": campaign}  # fmt: skip
    for name, text in text_files() if "campaigns" in groups else ():
        campaign = root / name.replace("/", "-")
        campaign.mkdir()
        (campaign / "campaign.toml").write_text(text)
        for command in TEXTS:
            yield "campaigns", name, command, {"campaign": campaign}
    points = root / "points"
    points.mkdir()
    for name, data in point_files() if "points" in groups else ():
        (points / name).write_bytes(data)
        for command in POINTS:
            yield "points", name, command, {"folder": points, "file": points / name}
    for name, file, content in damages() if demo and "databases" in groups else ():
        if only not in name and only != "databases":
            continue
        place = Path(tempfile.mkdtemp(dir=root))
        if linked_demo(demo, place, file, content) is None:
            continue
        (place / "points.csv").write_text("x,y\n1,2\n")
        told = {"file": place / "database", "folder": place, "demo": place}
        for command in DATABASES:
            if command[0] in next(names for part, names in OPENED_BY.items() if part in file):
                yield "databases", name, command, told
        subprocess.run(["rm", "-rf", str(place)], check=True)  # also where it is nested deeply


def warm_up(demo):
    """Run every command on sound files, so that what they import is counted nowhere."""
    import numpy as np
    import tifffile
    from typer.testing import CliRunner

    from levkas.cli import app

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tifffile.imwrite(folder / "icon1.tif", np.arange(2500, dtype=np.uint16).reshape(50, 50))
        text = CAMPAIGN.replace("KIND", "mosaic").replace("SUFFIX", ".tif")
        (folder / "campaign.toml").write_text(text)
        (folder / "points.csv").write_text("x,y\n1,2\n")
        told = {"folder": folder, "file": folder / "icon1.tif", "campaign": folder}
        for command in FRAMES:
            CliRunner().invoke(app, [part.format(**told) for part in command])
        told = {"folder": folder, "file": demo and demo / "database", "demo": demo}
        for command in DATABASES[:-2] if demo else ():
            CliRunner().invoke(app, [part.format(**told) for part in command])
    import levkas.workbench.server.app  # noqa: F401


def main():
    """Run all and print the table: a row a command, with the worst of its files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demo", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", default="", help="files whose group or name holds this text")
    parser.add_argument("--group", choices=GROUPS, help="only this kind of file is made at all")
    given = parser.parse_args()
    warm_up(given.demo)
    sys.path[:0] = [str(TESTS)]
    rows = []
    root = Path(tempfile.mkdtemp(prefix="levkas-hostile-"))
    (root / "frames").mkdir()
    try:
        groups = [given.only] if given.only in GROUPS else [given.group] if given.group else GROUPS
        for group, name, command, told in cases(root, given.demo, groups, given.only):
            if given.only not in group and given.only not in name:
                continue
            came = run([part.format(**told) for part in command])
            words = " ".join(part for part in command if not part.startswith(("{", "-", "1", "icon", "envi", "d80")))  # fmt: skip
            rows.append({"group": group, "file": name, "command": words, **came})
            print(f"{len(rows)} {name}: {words}", file=sys.stderr, flush=True)
            bad = came["outcome"] not in ("done", "refused", "served") or came["seconds"] > 5 or came["bytes"] > MEMORY  # fmt: skip
            if bad:
                print(json.dumps(rows[-1]), flush=True)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))
    by = defaultdict(list)
    for row in rows:
        by[row["group"], row["command"]].append(row)
    print("| files | command | runs | refused | done | served | other | most s | most MB |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for (group, command), found in by.items():
        count = [sum(r["outcome"] == o for r in found) for o in ("refused", "done", "served")]
        worst = max(found, key=lambda r: r["seconds"])["seconds"]
        largest = max(r["bytes"] for r in found) / 1e6
        print(f"| {group} | `{command}` | {len(found)} | {' | '.join(map(str, count))} | {len(found) - sum(count)} | {worst:.1f} | {largest:.0f} |")  # fmt: skip


if __name__ == "__main__":
    with redirect_stdout(sys.stdout), redirect_stderr(sys.stderr):
        main()
