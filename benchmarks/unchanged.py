"""Builds by two states of the code: what differs in the databases, file by file and number by number.

    python benchmarks/unchanged.py record FOLDER [--commit COMMIT] [--only NAME...]
    python benchmarks/unchanged.py compare FOLDER [--only NAME...] [--bytes] [-o JSON]

`record` keeps raw frames, databases, maps and reports of some campaigns in FOLDER, built by the code at hand or by that of
a commit; `compare` builds the same frames with the code at hand and ends with 1 where a limit is exceeded. ``--only quick`` takes
`QUICK`. With ``--bytes`` every byte has to be the same, but for what `differences.EXCLUDED` names.
Otherwise files and keys have to be there, words and flags the same, numbers within `differences.LIMITS`; other
differences are listed. The ledger beside a database (``.kept``) holds fingerprints and is not compared.
Needs only the command line, `levkas.open` and the layout of the database.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from differences import (
    EXCLUDED,
    LIMITS,
    Difference,
    compare_databases,
    compare_records,
    describe,
    largest,
)

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
"""What `--only quick` takes."""


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
                result[f"{name}|{frame}"] = painting.transform("grid", frame)(points)
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
