"""Builds by two states of the code: what differs in the databases, file by file and number by number.

    python benchmarks/unchanged.py record FOLDER [--commit COMMIT] [--only NAME...]
    python benchmarks/unchanged.py compare FOLDER [--only NAME...] [--bytes] [-o JSON]

`record` keeps raw frames, databases, maps and reports of some campaigns in FOLDER, built by the code at hand or by that of
a commit; `compare` builds the same frames with the code at hand and ends with 1 where a limit is exceeded. ``--only quick`` takes
`QUICK`. With ``--bytes`` every byte has to be the same, but for what `EXCLUDED` names.
Otherwise files and keys have to be there, words and flags the same, numbers within `LIMITS`; other
differences are listed. The ledger beside a database (``.kept``) holds fingerprints and is not compared.
Needs only the command line, `levkas.open` and the layout of the database.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import tomlkit
import zarr
from PIL import Image

HERE = Path(__file__).resolve().parents[1]
BUILT = "src/levkas/pages/screen/built"
POINTS = 9
"""Along either side of the grid, where maps are compared."""
BANDS = 25
"""Of a layer, spread over all, of which maps are compared."""
ERROR_FLOOR = 1e-3
"""Mean errors, px, that count as this where the change is taken relative to them."""
STREAMED = """
import importlib, pathlib, re, sys, levkas
home = pathlib.Path(levkas.__file__).parent
for name, number in (("STREAMED_SAMPLES", 0), ("BUFFER_BYTES", 3_000_000)):
    assigned = re.compile(rf"^(?:\\w+, )*{name}(?:, \\w+)* = ", re.M)
    holders = [p for p in home.rglob("*.py") if assigned.search(p.read_text())]
    if not holders:
        sys.exit(f"no module has {name}")
    for path in holders:
        dotted = ".".join(path.relative_to(home.parent).with_suffix("").parts).removesuffix(".__init__")
        setattr(importlib.import_module(dotted), name, number)
"""


# --- campaigns

FRAMES: dict[str, list[str] | str] = {
    "small": ["--preset", "small"],  # as `levkas demo` simulates it
    "tiny": ["--preset", "small", "--scale", "0.15", "--objects", "2", "--setups"],
    "charts": ["--preset", "default", "--scale", "0.1"],
    "two-paintings": "campaigns/two-paintings",
    "filterwheel-disks": "data/filterwheel-disks",
    "silios-kinect": "data/silios-kinect",
    "rededge": "data/rededge-5lens",
    "envi-linescan": "data/envi-linescan",
}
"""Raw frames: options of `levkas simulate`, or a folder in `shared` of which there is an example."""
ONE = {"targets.objects": ["icon1"]}
GRID = {"mirror": True, "rotate": 30, "region": [40, 30, 150, 120], "size": [200, 160]}
CAMPAIGNS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "demo": ("small", "", {}),
    "two-paintings": ("two-paintings", "", {}),
    "disks": ("filterwheel-disks", "", {}),
    "silios-kinect": ("silios-kinect", "", {}),
    "rededge": ("rededge", "", {}),
    "envi-linescan": ("envi-linescan", "", {}),
    "setups": ("tiny", "lctf-vis d80 msbs", ONE),
    "mirhashemi2019": (
        "tiny", "lctf-vis lctf-nir d80 msbs", {**ONE, "registration.method": "mirhashemi2019"},
    ),
    "merge": ("filterwheel-disks", "", {"cameras.flea3.exposures": "merge"}),
    "hysime": ("tiny", "lctf-vis lctf-nir", {**ONE, "cameras.lctf-vis.denoise": "hysime"}),
    "turned": ("tiny", "lctf-vis d80", {**ONE, "grid": GRID}),
    "points": ("tiny", "lctf-vis lctf-nir", {**ONE, "registration.points": "points.csv"}),
    "streamed": ("tiny", "lctf-vis v10", ONE),
    "refused": ("charts", "", {"cameras.v10.denoise": "hysime"}),  # too small to be registered
}  # fmt: skip
"""Name: raw frames, cameras that are kept (all without a name), keys of campaign.toml that are set."""
QUICK = {"envi-linescan", "turned", "streamed"}


def levkas(*arguments: str | Path, before: str = "") -> tuple[int, dict[str, Any]]:
    """Run the command of the code at hand; return its exit status and its JSON report."""
    code = before + "\nfrom levkas.cli import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        return done.returncode, json.loads(done.stdout)
    except ValueError:
        sys.exit(f"levkas {' '.join(command[3:])}: {done.returncode}\n{done.stdout}{done.stderr}")


def make_frames(folder: Path, name: str) -> Path:
    """Return the folder of raw frames with a campaign.toml; it is made where there is none."""
    target, maker = folder / "frames" / name, FRAMES[name]
    if target.is_dir():
        return target
    room = target.with_name(f"{name}.unfinished")
    shutil.rmtree(room, ignore_errors=True)
    room.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(maker, list):
        levkas("simulate", room, *maker)
    else:
        shutil.copytree(HERE.parent / "shared" / maker, room, copy_function=shutil.copyfile)
        for path in [room, *room.rglob("*")]:
            path.chmod(path.stat().st_mode | 0o200)
        text = (HERE / "examples" / name / "campaign.toml").read_text(encoding="utf-8")
        campaign = tomllib.loads(text.replace(f"../../../shared/{maker}/", ""))
        campaign["campaign"]["output"] = "database"
        (room / "campaign.toml").write_text(tomlkit.dumps(campaign), encoding="utf-8")
    return room.rename(target)


def make_campaign(folder: Path, name: str) -> Path:
    """Return a campaign's folder: the raw frames, linked, and a campaign.toml of its own."""
    target = folder / "campaigns" / name
    if target.is_dir():
        return target
    source, kept, changes = CAMPAIGNS[name]
    frames, room = make_frames(folder, source), target.with_name(f"{name}.unfinished")
    shutil.rmtree(room, ignore_errors=True)
    shutil.copytree(frames, room, copy_function=os.link)
    campaign = tomllib.loads((frames / "campaign.toml").read_text(encoding="utf-8"))
    for key, value in changes.items():
        *tables, last = key.split(".")
        place = campaign
        for table in tables:
            place = place.setdefault(table, {})
        place[last] = value
    keep(campaign.get("objects", {}), campaign["targets"]["objects"])
    for table in [campaign, *campaign.get("setups", {}).values()] if kept else []:
        keep(table["cameras"], kept.split())
    keep(
        campaign.get("setups", {}),
        [n for n, t in campaign.get("setups", {}).items() if t["cameras"]],
    )
    (room / "campaign.toml").unlink()
    (room / "campaign.toml").write_text(tomlkit.dumps(campaign), encoding="utf-8")
    if name == "points":
        write_points(room)
    return room.rename(target)


def keep(table: dict[str, Any], names: Iterable[str]) -> None:
    """Drop all other keys of a table."""
    for name in table.keys() - {*names}:
        del table[name]


def write_points(folder: Path) -> None:
    """Write check points of one band from the simulated truth."""
    truth = folder / "truth"
    reference = np.load(truth / "icon1_ref_px.npy")[::50]
    native = np.load(truth / "icon1_lctf-nir_px.npy")[1, ::50]
    rows = [
        f"icon1,lctf-nir,450 nm,{a},{b},{c},{d}"
        for (a, b), (c, d) in zip(reference, native, strict=True)
    ]
    head = "object,camera,band,reference_x,reference_y,x,y"
    (folder / "points.csv").write_text("\n".join([head, *rows, ""]), encoding="utf-8")


# --- what is kept of a build


def build_into(campaign: Path, target: Path) -> float:
    """Build into `target`/database, with maps and reports beside it; return the build's seconds."""
    room = target.with_name(f"{target.name}.unfinished")
    shutil.rmtree(room, ignore_errors=True)
    room.mkdir(parents=True)
    database, reports = room / "database", {}
    before = STREAMED if campaign.name == "streamed" else ""
    start = time.perf_counter()
    reports["build"] = levkas("build", campaign, "-o", database, before=before)
    seconds = time.perf_counter() - start
    truth = ["--truth", campaign / "truth"] if (campaign / "truth").is_dir() else []
    reports["evaluate"] = levkas("evaluate", database, *truth)
    reports["validate"] = levkas("validate", database)
    for name, (status, report) in reports.items():
        text = json.dumps({"status": status, **report}, indent=1)
        for place, label in ((room, "OUTPUT"), (campaign, "CAMPAIGN")):
            text = text.replace(str(place), label)
        (room / f"{name}.json").write_text(text, encoding="utf-8")
    np.savez(room / "maps.npz", **sample_maps(database))
    shutil.rmtree(target, ignore_errors=True)
    room.rename(target)
    return seconds


def sample_maps(database: Path) -> dict[str, np.ndarray]:
    """Return where points of the grid lie in bands, native px: (n, 2) by OBJECT|FRAME."""
    import levkas as package

    result = {}
    for name, painting in package.open(database).items():
        for camera, setup in painting.layers:
            layer = painting[camera, setup]
            ys, xs = (np.linspace(0, n - 1, POINTS) for n in layer.shape[:2])
            points = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
            count = len(layer.band)
            for number in np.unique(np.linspace(0, count - 1, min(count, BANDS)).astype(int)):
                band = layer.band.values[number]
                frame = f"{camera}@{setup}:{band}" if setup else f"{camera}:{band}"
                there = {"source": "grid", "target": frame}
                result[f"{name}|{frame}"] = package.map_points(database, name, points, **there)
    return result


# --- comparison of two such folders


def compare_builds(campaign: str, old: Path, new: Path, *, exact: bool) -> list[Difference]:
    """Return what differs between two builds, their maps and their reports."""
    found = list(compare_databases(campaign, old / "database", new / "database", exact=exact))
    for name in ("build", "evaluate", "validate"):
        records = [json.loads((f / f"{name}.json").read_text(encoding="utf-8")) for f in (old, new)]
        found += describe(campaign, f"{name}.json", compare_records(*records, EXCLUDED))
        if name == "evaluate":
            found += compare_errors(campaign, *records)
    with np.load(old / "maps.npz") as first, np.load(new / "maps.npz") as second:
        for key in first:
            if key not in second:
                found.append(Difference(campaign, "maps", "missing", key))
            elif size := largest(np.hypot(*(first[key] - second[key]).T), first[key], second[key]):
                found.append(Difference(campaign, "maps", "map", key, size, "px"))
    return found


def compare_errors(campaign: str, old: Any, new: Any) -> Iterator[Difference]:
    """Yield changes of the mean error of bands, in per cent."""
    before, after = (
        {
            (r["object"], r["camera"], r["setup"], b["band"]): b.get("error_mean")
            for r in record["results"]
            for b in r["bands"]
        }
        for record in (old, new)
    )
    for key in before.keys() & after.keys():
        first, second = before[key], after[key]
        if first is not None and second is not None and first != second:
            change = 100 * (second - first) / max(first, ERROR_FLOOR)
            text = f"{'/'.join(filter(None, key))}: {first:.5f} -> {second:.5f} px"
            yield Difference(campaign, "evaluate.json", "error", text, abs(change), "%")


# --- what differs: bytes first, what is inside a file where they do

LIMITS = {"values": 1e-5, "sigma": 1e-3, "flags": 0, "preview": 1, "map": 1e-3, "error": 2.0}
"""Largest difference: of values beyond one step of the 16 bits that are stored, where values exceed 1 in
parts of the largest; of sigma, relative (12 bits are stored); pixels; grey levels; px; per cent."""
UNITS = {"sigma": "relative", "flags": "px", "preview": "levels", "numbers": "relative"}
FAILING = {"missing", "record", "unreadable"}
"""Kinds that fail whatever their size; "new", "text" and "numbers" are only listed."""
EXCLUDED = {"fingerprint", "levkas", "libraries", "seconds", "sha256"}
"""Keys of records that are passed over; so are `code` and fingerprints of stages in provenance.json."""
LAYOUT = {"codecs", "chunk_grid", "chunk_key_encoding"}
LAYOUT_TAGS = {254, 259, 273, 278, 279, 305, 317, 322, 323, 324, 325}
STORED_STEP = 2.0**-15
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|\b(?:nan|inf)\b")
HASH = re.compile(r"\b[0-9a-f]{64}\b")
FINGERPRINT = re.compile(r'"[0-9a-f]{16}"')
"""Of an earlier stage, in provenance.json; it hangs on the code, too."""
CLOSE = 1e-9

Found = tuple[str, str, float, float]
"""Kind, detail, size, size in sigma; nan where there is none."""


@dataclass(frozen=True)
class Difference:
    """One thing that differs; `size` in `unit`, nan where it has none."""

    campaign: str
    file: str
    kind: str
    detail: str
    size: float = math.nan
    unit: str = ""
    sigmas: float = math.nan

    @property
    def fails(self) -> bool:
        return self.kind in FAILING or self.size > LIMITS.get(self.kind, math.inf)

    @property
    def line(self) -> str:
        size = "" if math.isnan(self.size) else f" {self.size:.3g} {self.unit}".rstrip()
        size += "" if math.isnan(self.sigmas) else f", {self.sigmas:.3g} sigma"
        return f"{self.kind}{size}: {self.file}: {self.detail}"


def compare_databases(campaign: str, old: Path, new: Path, *, exact: bool) -> Iterator[Difference]:
    """Yield what differs between the files of two databases; arrays of Zarr count as one file."""
    first, second = list_units(old), list_units(new)
    for name in sorted(first.keys() | second.keys()):
        if name not in second or name not in first:
            kind = "missing" if name not in second else "new"
            yield Difference(campaign, name, kind, "not in the new database" * (kind == "missing"))
            continue
        files = [{p.relative_to(root / name): p.read_bytes() for p in unit[name]}
                 for root, unit in ((old, first), (new, second))]  # fmt: skip
        if files[0] == files[1]:
            continue
        differences = describe(campaign, name, compare_unit(old / name, new / name, exact=exact))
        if exact and not differences and not explained(name):
            differences = [Difference(campaign, name, "bytes", "contents are the same")]
        yield from differences


def list_units(root: Path) -> dict[str, list[Path]]:
    """Return the files of a database by name; those of one Zarr array together."""
    units: dict[str, list[Path]] = {}
    arrays = {p.parent for p in root.rglob("zarr.json") if b'"array"' in p.read_bytes()}
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        home = next((p for p in path.parents if p in arrays), path)
        units.setdefault(home.relative_to(root).as_posix(), []).append(path)
    return units


def explained(name: str) -> bool:
    """Tell whether bytes of a file may differ for what is excluded."""
    return name.endswith("provenance.json") or name.startswith("manifest-")


def describe(campaign: str, file: str, found: Iterable[Found]) -> list[Difference]:
    """Return findings of one file: the largest of each kind that has a size, all others."""
    result: dict[Any, Difference] = {}
    for kind, detail, size, sigmas in found:
        key = detail if math.isnan(size) else kind
        if key not in result or size > result[key].size:
            result[key] = Difference(
                campaign, file, kind, detail, size, UNITS.get(kind, ""), sigmas
            )
    return list(result.values())


def compare_unit(old: Path, new: Path, *, exact: bool) -> Iterator[Found]:
    """Yield what differs inside two files, or two Zarr arrays, of other bytes."""
    try:
        if old.is_dir():
            yield from compare_zarr(old, new)
        elif old.suffix == ".tif":
            yield from compare_tiff(old, new)
        elif old.suffix == ".png":
            pictures = [np.asarray(Image.open(p)).astype(int) for p in (old, new)]
            yield from compare_arrays("preview", *pictures)
        else:
            texts = [p.read_text(encoding="utf-8") for p in (old, new)]
            if old.suffix == ".json":
                left_out = EXCLUDED - {"sha256"} if exact else EXCLUDED | LAYOUT
                if old.name == "provenance.json":
                    left_out = left_out | {"code"}
                    texts = [FINGERPRINT.sub('""', text) for text in texts]
                yield from compare_records(*map(json.loads, texts), left_out)
            elif old.name == "catalogue.csv":
                rows = [list(csv.DictReader(io.StringIO(text))) for text in texts]
                yield from compare_records(*rows, EXCLUDED)
            else:
                if old.name.startswith("manifest-"):
                    texts = [re.sub(r"\d+ (bytes|files)", r"\1", text) for text in texts]
                for kind, *rest in compare_words(*(HASH.sub("", text) for text in texts)):
                    yield ("text" if kind == "record" else kind), *rest
    except Exception as error:  # whatever a reader of a damaged file raises
        yield "unreadable", f"{type(error).__name__}: {error}", math.nan, math.nan


def compare_zarr(old: Path, new: Path) -> Iterator[Found]:
    records = [json.loads((p / "zarr.json").read_text(encoding="utf-8")) for p in (old, new)]
    yield from compare_records(*records, EXCLUDED | LAYOUT)
    arrays = [zarr.open_array(p, mode="r")[...] for p in (old, new)]
    sigma = old.with_name("sigma")
    known = old.name == "values" and sigma.is_dir()
    yield from compare_arrays(
        old.name if old.name in ("flags", "sigma") else "values", *arrays,
        zarr.open_array(sigma, mode="r")[...] if known else None,
    )  # fmt: skip


def compare_tiff(old: Path, new: Path) -> Iterator[Found]:
    kind = next((k for k in ("flags", "sigma") if old.name.endswith(f".{k}.tif")), "values")
    with tifffile.TiffFile(old) as first, tifffile.TiffFile(new) as second:
        if len(first.series) != len(second.series):
            yield "record", "other pictures in the file", math.nan, math.nan
            return
        for one, other in zip(first.series, second.series, strict=True):
            tags = [read_tags(s.pages[0]) for s in (one, other)]
            for name, detail, *rest in compare_records(*tags, EXCLUDED):
                yield name, f"tag {detail}", *rest
            shown = "preview" if kind == "values" and one.dtype == np.uint8 else kind
            sigma, arrays = old.with_suffix(".sigma.tif"), [one.asarray(), other.asarray()]
            known = shown == "values" and sigma.is_file()
            yield from compare_arrays(shown, *arrays, tifffile.imread(sigma) if known else None)


def read_tags(page: tifffile.TiffPage) -> dict[str, list[str]]:
    """Return the tags of a page by code, but for layout and software; a code may come twice."""
    tags: dict[str, list[str]] = {}
    for tag in page.tags.values():
        if tag.code not in LAYOUT_TAGS:
            tags.setdefault(str(tag.code), []).append(str(tag.value))
    return tags


def compare_arrays(
    kind: str, old: np.ndarray, new: np.ndarray, sigma: np.ndarray | None = None
) -> Iterator[Found]:
    """Yield how far two arrays of values, flags, sigma or grey levels are apart."""
    if old.shape != new.shape or old.dtype != new.dtype:
        text = f"{old.shape} {old.dtype} -> {new.shape} {new.dtype}"
        yield "record", text, math.nan, math.nan
    elif kind == "flags" or old.dtype.kind not in "fiu":
        if count := int((old != new).sum()):
            yield "flags" if kind == "flags" else "record", f"{count} differ", count, math.nan
    else:
        old, new = old.astype(np.float64), new.astype(np.float64)
        difference = np.abs(old - new)
        size = largest(difference, old, new)
        if not size:
            return
        sigmas = math.nan
        text = f"{np.count_nonzero((old != new) & (np.isfinite(old) | np.isfinite(new)))} pixels"
        with np.errstate(all="ignore"):
            if kind == "sigma":
                size = largest(difference / np.abs(old), old, new)
            elif kind == "values":
                if sigma is not None and sigma.shape == old.shape:
                    sigmas = largest(difference / sigma, old, new)
                text += f", largest {size:.3g}"
                steps = STORED_STEP * np.fmax(np.abs(old), np.abs(new))
                scale = np.max(np.abs(old), initial=1, where=np.isfinite(old))
                size = largest(np.maximum(difference - steps, 0), old, new) / float(scale)
        yield kind, text, size, sigmas


def largest(difference: np.ndarray, old: np.ndarray, new: np.ndarray) -> float:
    """Return the largest difference; inf where only one of the two is finite, or infinities differ."""
    with np.errstate(all="ignore"):
        same = (old == new) | (np.isnan(old) & np.isnan(new))
    if same.all():
        return 0.0
    if (~same & ~(np.isfinite(old) & np.isfinite(new))).any():
        return math.inf
    return float(np.nanmax(np.where(same.reshape((*difference.shape, -1)).all(-1), 0, difference)))


def compare_records(old: Any, new: Any, excluded: set[str], at: str = "") -> Iterator[Found]:
    """Yield what differs between two JSON records; keys that are excluded are passed over."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            place = f"{at}.{key}" if at else str(key)
            if key in excluded:
                continue
            if key not in new or key not in old:
                yield "new" if key in new else "missing", place, math.nan, math.nan
            else:
                yield from compare_records(old[key], new[key], excluded, place)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield "record", f"{at}: {len(old)} -> {len(new)} items", math.nan, math.nan
        for number, (one, other) in enumerate(zip(old, new, strict=False)):
            yield from compare_records(one, other, excluded, f"{at}[{number}]")
    elif is_number(old) and is_number(new):
        both_nan = math.isnan(old) and math.isnan(new)
        if not both_nan and not math.isclose(old, new, rel_tol=CLOSE, abs_tol=CLOSE):
            yield "numbers", f"{at}: {old} -> {new}", relative(old, new), math.nan
    elif isinstance(old, str) and isinstance(new, str):
        yield from compare_words(old, new, at)
    elif old != new or type(old) is not type(new):
        yield "record", f"{at}: {old!r} -> {new!r}"[:200], math.nan, math.nan


def compare_words(old: str, new: str, at: str = "") -> Iterator[Found]:
    """Yield whether two texts differ in words, else how far their numbers are apart."""
    if old == new:
        return
    if NUMBER.sub("#", old) != NUMBER.sub("#", new):
        start = next((n for n, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), 0)
        text = f"{at}: …{old[max(0, start - 20) :][:80]!r} -> …{new[max(0, start - 20) :][:80]!r}"
        yield "record", text, math.nan, math.nan
        return
    pairs = zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
    sizes = [(relative(float(a), float(b)), a, b) for a, b in pairs if a != b]
    size, first, second = max(sizes)
    yield "numbers", f"{at}: {first} -> {second}", size, math.nan


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def relative(old: float, new: float) -> float:
    size = abs(old - new) / max(abs(old), abs(new), 1e-300)
    return size if math.isfinite(size) else math.inf


# --- commands


def unpack(commit: str, folder: Path) -> Path:
    """Return the sources of a commit with the pages that are built here; they are unpacked where there are none."""
    git = ["git", "-C", str(HERE)]
    command = [*git, "rev-parse", "--verify", f"{commit}^{{commit}}"]
    name = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    target = folder / "code" / name
    if not target.is_dir():
        room = target.with_name(f"{name}.unfinished")
        shutil.rmtree(room, ignore_errors=True)
        packed = subprocess.run([*git, "archive", name, "src"], capture_output=True, check=True)
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
            archive.extractall(room, filter="data")
        if (HERE / BUILT).is_dir():
            shutil.copytree(HERE / BUILT, room / BUILT)
        room.rename(target)
    return target / "src"


def record_commit(commit: str, folder: Path, names: list[str]) -> int:
    """Record by the code of a commit, in a process that imports it."""
    code = {**os.environ, "PYTHONPATH": str(unpack(commit, folder)), "PYTHONUTF8": "1"}
    command = [sys.executable, __file__, "record", str(folder), "--only", *names]
    return subprocess.run(command, env=code, check=False).returncode


def record(folder: Path, names: list[str]) -> int:
    for name in names:
        seconds = build_into(make_campaign(folder, name), folder / "recorded" / name)
        print(f"{name}: recorded, built in {seconds:.0f} s", flush=True)
    return 0


def compare(folder: Path, names: list[str], *, exact: bool, output: Path | None) -> int:
    everything, failed = [], 0
    for name in names:
        recorded = folder / "recorded" / name
        if not recorded.is_dir():
            print(f"{name}: not recorded")
            failed += 1
            continue
        with tempfile.TemporaryDirectory(prefix="unchanged-") as room:
            seconds = build_into(make_campaign(folder, name), Path(room) / name)
            found = compare_builds(name, recorded, Path(room) / name, exact=exact)
        bad = [d for d in found if exact or d.fails]
        failed += bool(bad)
        summary = f"{len(bad)} beyond the limits, {len(found)} differences" if found else "equal"
        print(f"{name}: {summary}; built in {seconds:.0f} s", flush=True)
        for one in sorted(found, key=lambda d: d not in bad):
            print(f"  {'!' if one in bad else ' '} {one.line}")
        everything += [{**asdict(d), "fails": d in bad} for d in found]
    passed_over = ", ".join(sorted(EXCLUDED - {"sha256"} if exact else EXCLUDED))
    print(f"excluded: {passed_over}; code and fingerprints in provenance.json; the ledger")
    if output:
        summary = {"bytes": exact, "limits": LIMITS, "campaigns": names, "differences": everything}
        output.write_text(json.dumps(summary, indent=1), encoding="utf-8")
    return int(failed > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=["record", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--only", nargs="+", choices=["quick", *CAMPAIGNS], metavar="NAME", default=[]
    )
    parser.add_argument("--commit", help="of `record`: build by the code of this commit")
    parser.add_argument("--bytes", action="store_true", help="every byte has to be the same")
    parser.add_argument("-o", "--output", type=Path, help="differences as JSON")
    given = parser.parse_args()
    quick = "quick" in given.only
    names = [n for n in CAMPAIGNS if not given.only or n in given.only or (quick and n in QUICK)]
    folder = given.folder.resolve()
    if given.commit:
        if given.command == "compare":
            parser.error("--commit is of `record`; `compare` takes the code at hand")
        return record_commit(given.commit, folder, names)
    print(f"code: {Path(find_spec('levkas').origin).parent}", flush=True)
    if given.command == "record":
        return record(folder, names)
    return compare(folder, names, exact=given.bytes, output=given.output)


if __name__ == "__main__":
    sys.exit(main())
