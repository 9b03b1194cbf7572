"""Methods of registration side by side: ours, the paper's, its opponents and today's peers; Figure 14 of the paper.

    python benchmarks/methods.py CAMPAIGN [-o FOLDER] [--method NAME]... [--object NAME]... [--limit S]

Registers every layer of a built campaign anew by each method, from the native bands (`native = true` under
`[database]`), each run in a process of its own. Prints a line a run and a table; FOLDER gets comparison.json, the
SSIM maps and figure_14.png. Errors are in reference px where the campaign has a truth. `make compare` runs it with
all peers; what is not installed is left out, and said.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.machine import count_threads
from levkas.core.problems import Refused
from levkas.core.text import read_json
from levkas.database.registrations import read_registrations
from levkas.geometry import from_dict
from levkas.geometry.transforms import Composed
from levkas.quality.evaluation.layer_report import find_truth, locate
from levkas.registration import BandImage, register
from levkas.registration.methods import METHODS

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from levkas_peers.native import NativeLayer, read_native_layer
from levkas_peers.pair import AnyMap, NoAnswer, pair_of

Map = Callable[[np.ndarray], np.ndarray]
TIME_LIMIT_S = 600.0
THREADS_OF = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LEVKAS_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)  # fmt: skip
SHOWN = ("levkas", "mirhashemi2019", "gdbicp-radial", "surf-projective")
"""Methods whose SSIM maps the figure has."""
INKS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#000000", "#56b4e9")


@dataclass(frozen=True)
class ComparedMethod:
    """One row of the comparison.

    `module` and `function` say where it is, among `levkas.registration`'s own where `module` is empty; `package`
    is what must be installed, as it is imported, and `distribution` its name for a package manager.
    """

    title: str
    module: str = ""
    function: str = ""
    package: str = ""
    distribution: str = ""

    @property
    def missing(self) -> str:
        """What the method needs and is not there; empty where it can run."""
        absent = self.package and find_spec(self.package) is None
        return f"{self.distribution} is not installed" if absent else ""

    @property
    def version(self) -> str:
        """Version of the package; empty for what is written here."""
        try:
            return version(self.distribution) if self.distribution else ""
        except PackageNotFoundError:
            return ""


def _peer(title: str, module: str, function: str, *package: str) -> ComparedMethod:
    return ComparedMethod(title, f"levkas_peers.{module}", function, *package)


OPENCV = ("cv2", "opencv-python-headless")
COMPARED = {
    "levkas": ComparedMethod("Levkas"),
    "mirhashemi2019": ComparedMethod("Mirhashemi 2019"),
    "surf-projective": _peer("SURF, projective", "surf", "surf_projective", "mahotas", "mahotas"),
    "gdbicp-quadratic": _peer("GDB-ICP, quadratic", "dual_bootstrap", "gdbicp_quadratic"),
    "gdbicp-radial": _peer("GDB-ICP, homography and radial", "dual_bootstrap", "gdbicp_radial"),
    "opencv-sift-magsac": _peer("OpenCV SIFT, MAGSAC", "opencv", "opencv_sift_magsac", *OPENCV),
    "opencv-ecc": _peer("OpenCV ECC", "opencv", "opencv_ecc", *OPENCV),
    "elastix": _peer("elastix", "intensities", "elastix", "itk", "itk-elastix"),
    "simpleitk": _peer("SimpleITK", "intensities", "simpleitk", "SimpleITK", "simpleitk"),
    "ants": _peer("ANTs SyN", "intensities", "ants", "ants", "antspyx"),
}
COMPARED |= {name: ComparedMethod(name) for name in METHODS if name not in COMPARED}
"""Last those of installed packages."""


@dataclass(frozen=True)
class Trial:
    """One run of a method: plain values, to be sent to another process as JSON.

    `layer` is CAMERA or CAMERA@SETUP; `truth` the folder of the truth and `map` the PNG of the SSIM map, or empty.
    """

    database: str
    object: str
    layer: str
    method: str
    truth: str = ""
    map: str = ""


def run_trial(trial: Trial) -> dict[str, Any]:
    """Run a trial and return its row; without a map, the row holds the reason in `failure`."""
    database = Path(trial.database)
    folder = database / "objects" / trial.object / "registration"
    record = read_json(folder / f"{trial.layer}.json")
    base = record["reference"]
    own = read_json(folder / f"{base['camera']}.json")
    reference = read_native_layer(database, trial.object, base["camera"], "")
    target = read_native_layer(database, trial.object, record["camera"], record.get("setup") or "")
    maps = {label: from_dict(band["transform"]) for label, band in own["bands"].items()}
    given = reference.images(), target.images(), base["band"], maps, region(record)
    method = COMPARED[trial.method]
    if method.package:
        import_module(method.package)
    if not method.module:
        _load(trial.method)
    before = _peak_mib()
    start, worked = time.perf_counter(), time.process_time()
    try:
        found, decision, note = run_method(trial.method, *given)
        failure = "refused: " + note if decision == "refuse" else ""
    except NoAnswer as error:
        found, decision, note, failure = {}, "none", "", str(error)
    return {
        "object": trial.object,
        "layer": trial.layer,
        "method": trial.method,
        "seconds": round(time.perf_counter() - start, 3),
        "cpu_seconds": round(time.process_time() - worked, 3),
        "peak_mib": _peak_mib(),
        "before_mib": before,
        "decision": decision,
        "note": note[:300],
        "failure": failure,
        "bands": [] if failure else _errors(trial, record, found),
        "ssim": None if failure else _similarity(trial, record, target, found),
    }


def run_method(
    name: str,
    ours: Sequence[BandImage],
    theirs: Sequence[BandImage],
    band: str,
    reference_maps: dict[str, Any],
    region: Sequence[float] | None,
) -> tuple[dict[str, Map], str, str]:
    """Return (band → map from reference px to native px, decision, note); raises NoAnswer."""
    method = COMPARED[name]
    if method.module:
        maps: dict[str, Map] = {}
        for sensor in dict.fromkeys(image.sensor for image in theirs):
            images = [image for image in theirs if image.sensor == sensor]
            pair = pair_of(ours, images, band, region)
            answer = getattr(import_module(method.module), method.function)(pair)
            maps |= dict.fromkeys((image.label for image in images), pair.whole(answer.found))
        return maps, answer.decision, answer.note
    options: dict[str, Any] = {"method": name, "region": region}
    options |= {"reference_band": band, "reference_transforms": reference_maps}
    try:
        found = register(ours, theirs, **options)
    except Refused as refused:
        raise NoAnswer("; ".join(p.message for p in refused.problems)) from refused
    verdict = found.verdict
    return dict(found.transforms), verdict.decision, "; ".join(verdict.reasons)


def region(record: dict[str, Any]) -> tuple[float, ...] | None:
    """Return the grid's bounding box in reference px; None where that is the whole frame."""
    (width, height), size = record["grid"]["size"], record["reference"]["size"]
    x, y = np.array([-0.5, width - 0.5]), np.array([-0.5, height - 0.5])
    corners = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    placed = from_dict(record["grid"]["transform"])(corners)
    low = np.maximum(np.floor(placed.min(0) + 0.5), 0)
    high = np.minimum(np.ceil(placed.max(0) + 0.5), size)
    if (low == 0).all() and (high == size).all():
        return None
    return (*map(float, low), *map(float, high - low))


def _peak_mib() -> int:
    import resource

    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def _load(method: str) -> None:
    """Register a little noise, so that compiled code is in memory before the clock runs."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(1).standard_normal((2, 200, 240)), (0, 1.5, 1.5))
    bands = [BandImage.of(label, 1 + v - v.min()) for label, v in zip("ab", noise, strict=True)]
    with suppress(Refused):
        register(bands, [*bands], reference_band="a", method=method)


def _errors(trial: Trial, record: dict[str, Any], maps: dict[str, Map]) -> list[dict[str, Any]]:
    """Errors of every band in reference px: the miss in native px, brought back by the map's slope."""
    from levkas.quality.evaluation.similarity import inside, read_truth, summarise_errors

    truth = read_truth(Path(trial.truth), trial.object, record["camera"]) if trial.truth else None
    grid = from_dict(record["grid"]["transform"])
    rows = []
    for label, found in maps.items():
        if truth is None or label not in truth.bands:
            continue
        points, goal = truth.reference, truth.bands[label]
        keep = inside(grid.inverse(points), record["grid"]["size"]) & np.isfinite(goal).all(1)
        keep &= inside(goal, record["bands"][label]["size"])
        map_ = AnyMap(found)
        miss = map_(points[keep]) - goal[keep]
        with np.errstate(all="ignore"):
            away = np.linalg.solve(map_.jacobian(points[keep]), miss[..., None])[..., 0]
        errors = np.linalg.norm(away, axis=1)
        rows.append(summarise_errors(label, errors, points[keep]).to_dict())
    return [row for row in rows if row["points"]]


def _similarity(
    trial: Trial, record: dict[str, Any], target: NativeLayer, maps: dict[str, Map]
) -> float | None:
    """SSIM of the mean of the registered bands against the reference's published layer."""
    from levkas.database.grey import grey_of, grey_step, read_grey
    from levkas.database.layout import Places
    from levkas.database.preview import encode_png
    from levkas.geometry.resample import warp
    from levkas.quality.evaluation.similarity import structural_similarity

    grid = from_dict(record["grid"]["transform"])
    shape = tuple(record["grid"]["size"][::-1])
    parts = []
    for values, flags, labels, _ in target.sensors.values():
        found = [Composed(grid, AnyMap(maps[label])) for label in labels]
        alone = len({id(maps[label]) for label in labels}) == 1
        parts.append(warp(values, found[0] if alone else found, shape, flags=flags))
    ours = grey_of(
        np.concatenate([p.values for p in parts], axis=2),
        np.concatenate([p.flags for p in parts], axis=2),
        step=grey_step(*shape),
    )
    layer = Places(Path(trial.database)).layer(trial.object, record["reference"]["camera"])
    base = read_grey(layer)
    score, full = structural_similarity(base[0], ours[0], base[1] & ours[1])
    if trial.map:
        shown = np.nan_to_num(np.clip(full, 0, 1) * 255).astype(np.uint8)
        Path(trial.map).write_bytes(encode_png(shown, description="SSIM, 0 to 1"))
    return None if np.isnan(score) else float(score)


def compare(
    campaign: Path,
    methods: Sequence[str],
    objects: Sequence[str] = (),
    output: Path | None = None,
    limit_s: float = TIME_LIMIT_S,
) -> Iterator[dict[str, Any]]:
    """Yield a row a layer and method, in that order; SSIM maps are written into `output`."""
    database, beside = (path.resolve() for path in locate(campaign))
    truth = find_truth(None, beside)
    for path, record in read_registrations(database):
        name, layer = path.parents[1].name, path.stem
        is_own = record["camera"] == record["reference"]["camera"] and not record.get("setup")
        if is_own or (objects and name not in objects):
            continue
        for method in methods:
            drawn = f"{name}_{layer.replace('@', '_')}_{method}_ssim.png"
            where = str(output.resolve() / drawn) if output else ""
            row = _in_a_child(
                Trial(str(database), name, layer, method, str(truth or ""), where), limit_s
            )
            yield {**row, "map": drawn if where and not row["failure"] else ""}


def _in_a_child(trial: Trial, limit_s: float) -> dict[str, Any]:
    settings = dict.fromkeys(THREADS_OF, str(count_threads()))
    settings["PYTHONPATH"] = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    lost = {"object": trial.object, "layer": trial.layer, "method": trial.method, "bands": []}
    # Some peers leave files where they run: that place is thrown away.
    try:
        with tempfile.TemporaryDirectory() as scratch:
            done = subprocess.run(
                [sys.executable, str(Path(__file__).resolve()), "--trial", json.dumps(asdict(trial))],
                text=True, capture_output=True, cwd=scratch, timeout=limit_s, check=False,
                env={**os.environ, **settings},
            )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {**lost, "failure": f"stopped after {limit_s:g} s", "seconds": limit_s}
    try:
        row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {**lost, "failure": f"ended with status {done.returncode}: {last[-160:]}"}
    return row


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a record a method, over the layers that it registered.

    Errors are means over layers of the means over bands; the worst is of any point of any band.
    """
    found = []
    for name in dict.fromkeys(row["method"] for row in rows):
        here = [row for row in rows if row["method"] == name]
        good = [row for row in here if not row["failure"]]
        means = [[band["error_mean"] for band in row["bands"]] for row in good]
        found.append(
            {
                "method": name,
                "title": f"{COMPARED[name].title} {COMPARED[name].version}".strip(),
                "layers": len(here),
                "failures": len(here) - len(good),
                "error_mean": _mean(sum(m) / len(m) for m in means if m),
                "error_worst_band": max((max(m) for m in means if m), default=None),
                "error_max": max((b["error_max"] for r in good for b in r["bands"]), default=None),
                "ssim": _mean(row["ssim"] for row in good),
                "seconds": _mean(row.get("seconds") for row in here),
                "cpu_seconds": _mean(row.get("cpu_seconds") for row in here),
                "peak_mib": max((r["peak_mib"] for r in here if "peak_mib" in r), default=None),
            }
        )
    return found


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def text(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table, a line a method."""
    columns = {"error_mean": 3, "error_worst_band": 3, "error_max": 2, "ssim": 3}
    columns |= {"seconds": 1, "cpu_seconds": 1, "peak_mib": 0}
    lines = [f"{'':40}{'failed':>8}" + "".join(f"{name:>17}" for name in columns)]
    for one in summary(rows):
        cells = ["–" if one[n] is None else f"{one[n]:.{digits}f}" for n, digits in columns.items()]
        failed = f"{one['failures']}/{one['layers']}"
        lines.append(f"{one['title']:40}{failed:>8}" + "".join(f"{c:>17}" for c in cells))
    return "\n".join(lines)


def draw(rows: Sequence[dict[str, Any]], folder: Path) -> Any:
    """Draw Figure 14: SSIM of every layer by each method above, the maps of one layer below; return the figure."""
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    layers = list(dict.fromkeys(f"{r['object']} {r['layer']}" for r in rows))
    methods = list(dict.fromkeys(r["method"] for r in rows))
    figure = Figure((9, 6.4), layout="constrained")
    whole = figure.subfigures(2, 1, height_ratios=(1.25, 1))
    axes = whole[0].subplots()
    for place, method in enumerate(methods):
        scores = {
            f"{r['object']} {r['layer']}": r.get("ssim") for r in rows if r["method"] == method
        }
        values = np.array([scores.get(layer) for layer in layers], float)
        # Layers have no order: points beside one another, and no line between them.
        at = np.arange(len(layers)) + (place - (len(methods) - 1) / 2) * 0.06
        ink, mark = INKS[place % len(INKS)], "osD^vP*"[place % 7]
        axes.plot(at, values, mark, color=ink, ms=6, label=method)
    axes.set_xticks(range(len(layers)), layers)
    axes.set(ylabel="SSIM to the reference camera")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    one = rows[0]["object"], rows[0]["layer"]
    of_one = {r["method"]: r for r in rows if (r["object"], r["layer"]) == one and r.get("map")}
    for panel, method in zip(whole[1].subplots(1, len(SHOWN)), SHOWN, strict=True):
        panel.axis("off")
        if method in of_one:
            panel.imshow(imread(folder / of_one[method]["map"]), cmap="gray", vmin=0, vmax=1)
            panel.set_title(f"{method}\n{of_one[method]['ssim']:.3f}", fontsize=9)
    figure.savefig(folder / "figure_14.png", dpi=100)
    return figure


def answer_trial(trial: str) -> None:
    """Run a trial given as JSON, and print its row as the last line."""
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints must not stand in the answer
    one = Trial(**json.loads(trial))
    try:
        row = run_trial(one)
    except (Refused, ImportError) as error:
        kept = {"object": one.object, "layer": one.layer, "method": one.method, "bands": []}
        row = {**kept, "failure": f"{type(error).__name__}: {error}"}
    os.write(out, (json.dumps(row) + "\n").encode())


def main() -> None:
    """Compare the methods that are installed on the layers of a campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("campaign", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--method", action="append", choices=list(COMPARED))
    parser.add_argument("--object", action="append", default=[])
    parser.add_argument("--limit", type=float, default=TIME_LIMIT_S, help="of one run, s")
    parser.add_argument("--trial", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.trial:
        return answer_trial(options.trial)
    if options.campaign is None:
        parser.error("give a campaign, or its database")
    wanted = options.method or list(COMPARED)
    for name in wanted:
        if why := COMPARED[name].missing:
            print(f"{name} is left out: {why}")
    wanted = [name for name in wanted if not COMPARED[name].missing]
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in compare(options.campaign, wanted, options.object, options.output, options.limit):
        result = row["failure"][:100] or f"{row['seconds']:.1f} s"
        print(f"{row['object']}/{row['layer']} {row['method']}: {result}", flush=True)
        rows.append(row)
    if not rows:
        sys.exit("no layer of this database was registered to another camera")
    print(text(rows))
    if options.output:
        content = {"methods": summary(rows), "comparison": rows}
        (options.output / "comparison.json").write_text(json.dumps(content, indent=1))
        draw(rows, options.output)


if __name__ == "__main__":
    main()
