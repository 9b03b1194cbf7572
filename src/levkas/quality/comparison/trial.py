"""One method on one layer: registered, timed, measured against truth, check points and SSIM."""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Refused
from levkas.core.text import read_json
from levkas.geometry import from_dict
from levkas.geometry.transforms import Composed
from levkas.quality.comparison.methods import COMPARED, AnyMap, NoAnswer, pair_of, spread
from levkas.quality.evaluation.native_layers import NativeLayer, read_native_layer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from levkas.registration import BandImage

    Map = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Trial:
    """One run of a method: plain values, to be sent to another process as JSON.

    Parameters
    ----------
    database : str
    object, layer, method : str
        `layer` is CAMERA or CAMERA@SETUP.
    truth : str
        Folder of the truth, or empty.
    checks : dict of str to list
        Band → rows of reference x, y and native x, y.
    map : str
        PNG of the SSIM map to write, or empty.
    """

    database: str
    object: str
    layer: str
    method: str
    truth: str = ""
    checks: dict[str, list[list[float]]] | None = None
    map: str = ""


def run_trial(trial: Trial) -> dict[str, Any]:
    """Run a trial and return its row; without a map, the row holds the reason in `failure`."""
    database = Path(trial.database)
    folder = database / "objects" / trial.object / "registration"
    record = read_json(folder / f"{trial.layer}.json")
    camera, setup = record["camera"], record.get("setup", "")
    base = record["reference"]
    reference = read_native_layer(database, trial.object, base["camera"], "")
    target = read_native_layer(database, trial.object, camera, setup)
    own = read_json(folder / f"{base['camera']}.json")
    ours, theirs = reference.images(), target.images()
    method = COMPARED[trial.method]
    if method.package:
        import_module(method.package)
    given = _given(trial.method, ours, theirs, base["band"], own, _region(record))
    before = _peak_mib()
    start, worked = time.perf_counter(), time.process_time()
    try:
        maps, decision, note = _register(trial.method, given)
        failure = "refused: " + note if decision == "refuse" else ""
    except NoAnswer as error:
        maps, decision, note, failure = {}, "none", "", str(error)
    row: dict[str, Any] = {
        "seconds": round(time.perf_counter() - start, 3),
        "cpu_seconds": round(time.process_time() - worked, 3),
        "peak_mib": _peak_mib(),
        "before_mib": before,
        "decision": decision,
        "note": note,
        "failure": failure,
        "bands": [],
        "ssim": None,
    }
    if not failure:
        row["bands"] = _errors(trial, record, maps)
        row["ssim"] = _similarity(trial, record, target, maps)
    return row


def _peak_mib() -> int | None:
    """Return the most memory that this process has held, MiB; None on systems without `resource`."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def _region(record: dict[str, Any]) -> tuple[float, ...] | None:
    """The grid's bounding box in reference px; None where that is the whole frame."""
    width, height = record["grid"]["size"]
    corners = np.array(
        [[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]]
    )
    placed = from_dict(record["grid"]["transform"])(corners)
    low = np.maximum(np.floor(placed.min(0) + 0.5), 0)
    high = np.minimum(np.ceil(placed.max(0) + 0.5), record["reference"]["size"])
    if (low == 0).all() and (high == record["reference"]["size"]).all():
        return None
    return (*map(float, low), *map(float, high - low))


def _given(
    name: str,
    ours: list[BandImage],
    theirs: list[BandImage],
    band: str,
    own: dict[str, Any],
    region: Sequence[float] | None,
) -> tuple[Any, ...]:
    """Prepare the arguments of a method, and load compiled code, before the clock runs."""
    if COMPARED[name].module:
        return pair_of(ours, theirs, band, region)
    maps = {k: from_dict(b["transform"]) for k, b in own["bands"].items()}
    options: dict[str, Any] = {
        "reference_band": band,
        "method": name,
        "region": region,
        "reference_transforms": maps,
    }
    _load(name)
    return ours, theirs, options


def _load(method: str) -> None:
    """Register a little noise, so that compiled code is in memory before the clock runs."""
    from scipy.ndimage import gaussian_filter

    from levkas.registration import BandImage, register

    noise = gaussian_filter(np.random.default_rng(1).standard_normal((2, 200, 240)), (0, 1.5, 1.5))
    bands = [BandImage.of(label, 1 + v - v.min()) for label, v in zip("ab", noise, strict=True)]
    with suppress(Refused):
        register(bands, [*bands], reference_band="a", method=method)


def _register(name: str, given: tuple[Any, ...]) -> tuple[dict[str, Map], str, str]:
    """Return (band → map from reference px to native px, decision, note)."""
    method = COMPARED[name]
    if method.module:
        pair, camera = given
        answer = getattr(import_module(method.module), method.function)(pair)
        return spread(camera, pair.whole(answer.found)), answer.decision, answer.note
    from levkas.registration import register

    ours, theirs, options = given
    try:
        found = register(ours, theirs, **options)
    except Refused as refused:
        raise NoAnswer("; ".join(p.message for p in refused.problems)) from refused
    return (
        dict(found.transforms),
        found.verdict.decision,
        shorten("; ".join(found.verdict.reasons), 300, placeholder=" …"),
    )


def _errors(trial: Trial, record: dict[str, Any], maps: dict[str, Map]) -> list[dict[str, Any]]:
    """Errors of every band in reference px: the miss in native px, brought back by the map's slope."""
    from levkas.quality.evaluation.similarity import inside, read_truth, summarise_errors

    truth = read_truth(Path(trial.truth), trial.object, record["camera"]) if trial.truth else None
    checks = {k: np.array(v, float) for k, v in (trial.checks or {}).items()}
    grid = from_dict(record["grid"]["transform"])
    rows = []
    for label, found in maps.items():
        if truth is not None and label in truth.bands:
            points, goal = truth.reference, truth.bands[label]
        elif label in checks:
            points, goal = checks[label][:, :2], checks[label][:, 2:]
        else:
            continue
        keep = inside(grid.inverse(points), record["grid"]["size"]) & np.isfinite(goal).all(1)
        keep &= inside(goal, record["bands"][label]["size"])
        map_ = AnyMap(found)
        miss = map_(points[keep]) - goal[keep]
        with np.errstate(all="ignore"):
            away = np.linalg.solve(map_.jacobian(points[keep]), miss[..., None])[..., 0]
        errors = np.linalg.norm(away, axis=1)
        rows.append(summarise_errors(label, errors, points[keep]).to_dict())
    return rows


def _similarity(
    trial: Trial, record: dict[str, Any], target: NativeLayer, maps: dict[str, Map]
) -> float | None:
    """SSIM of the mean of the registered bands against the reference's published layer."""
    from levkas.database.grey import grey_of, grey_step, read_grey
    from levkas.database.layout import Places
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
    base = read_grey(
        Places(Path(trial.database)).layer(trial.object, record["reference"]["camera"])
    )
    score, full = structural_similarity(base[0], ours[0], base[1] & ours[1])
    if trial.map:
        from levkas.database.preview import write_preview

        shown = np.nan_to_num(np.clip(full, 0, 1) * 255).astype(np.uint8)
        write_preview(trial.map, shown, description="SSIM, 0 to 1")
    return None if np.isnan(score) else float(score)


def main() -> None:
    """Read a trial as JSON, run it, print its row as the last line."""
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints must not stand in the answer
    try:
        row = run_trial(Trial(**json.load(sys.stdin)))
    except (Refused, ImportError) as error:
        row = {"failure": f"{type(error).__name__}: {error}"}
    os.write(out, (json.dumps(row) + "\n").encode())


if __name__ == "__main__":
    main()
