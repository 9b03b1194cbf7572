"""Registration records of a database, validated before use."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.core.text import counted, read_json
from levkas.database.manifest import check_inside, check_plain_names
from levkas.geometry import from_dict
from levkas.readers.orientation import describe_turn, grid_keys
from levkas.registration.advice import describe_placement
from levkas.registration.foreground import contains
from levkas.registration.record import Sigma, decided
from levkas.registration.window_matching import CheckWindows

WHOLE = ("object", "camera", "reference", "verdict")
"""Parts of every record that a build writes."""
MOST_PX = 1 << 20
"""Sides of grids and frames; far more than any sensor or scan has."""
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
WRONG = (ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError, MemoryError)
"""What numpy and `levkas.geometry.transforms` raise on numbers that are not those of a transform."""
Check = tuple[tuple[type, ...], Callable[[Any], object]]
"""Kinds that a part may be of, and what raises one of `WRONG` where it is wrong."""
MOST_UNLIKE = 1.03
"""Ratio of the scales of an object's two sides, px by mm, up to which its outline and its size are of one thing: a panel is
rectangular, and its size right, within 1 %."""


class RecordRefused(Refused):
    """A registration record is damaged, or was not written by a registration."""


def read_registration(path: Path, *, needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """Read the record of one layer, of which the `needed` parts must be there.

    Raises RecordRefused where it cannot be read, or a part of it is of another kind than a registration writes.
    """
    try:
        record = read_json(path)
    except Refused as refused:
        raise RecordRefused(*refused.problems) from None
    field = ""
    try:
        for field, (kinds, check), part in _parts(record):
            if part is None and field in CHECKS and field not in needed:
                continue
            if not isinstance(part, kinds):
                raise TypeError("it is missing or of another kind")
            check(part)
    except WRONG as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        what, fix = f"{path.name} is not a registration record: {reason}", "Copy the file again."
        expected = "a record as a build writes it"
        raise RecordRefused(
            Problem("E_VALUE", what, str(path), field, None, expected, fix)
        ) from error
    return record


def read_registrations(database: Path, name: str = "*") -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield (path, record) of every layer of a database, or of one object, in order.

    Raises RecordRefused also where a part is missing that a build writes, LinkRefused where a record is a link that leads out.
    """
    for path in sorted(database.glob(f"objects/{name}/registration/*.json")):
        check_inside(database, path)
        yield path, read_registration(path, needed=WHOLE)


def _parts(record: dict[str, Any]) -> Iterator[tuple[str, Check, Any]]:
    """Yield (field, how it is checked, part)."""
    yield from ((key, check, record.get(key)) for key, check in CHECKS.items())
    for tile, part in {"": record, **(record.get("tiles") or {})}.items():
        if tile:
            yield f"verdict of {tile}", CHECKS["verdict"], part.get("verdict")
        for label, band in (part.get("bands") or {}).items():
            yield f"bands: {tile} {label}", CHECKS["grid"], band


def _check_frame(part: Any) -> None:
    if isinstance(part, str):
        return
    names = [part.get(key) or "" for key in ("camera", "setup", "band")]
    if not all(isinstance(name, str) for name in names):
        raise TypeError("camera, setup or band is not text")
    check_plain_names(names[0] or "-", names[1] or "-")
    _check_size(part.get("size"))


def _check_verdict(part: Any) -> None:
    if (type(part.get("decision", "")), type(part.get("reasons", []))) != (str, list):
        raise TypeError("it is not text")
    if any(len(cell) != 4 for cell in unconfirmed_cells({"verdict": part})):
        raise TypeError("a cell is not a rectangle")
    describe_pairs({"verdict": part})
    decided(part)


def _check_errors(part: Any) -> None:
    for one in part.get("check_points") or []:
        float(one["error"] or 0), str(one["band"])
    shares_light({"errors": part}, ())


def _check_map(part: Any) -> None:
    """Map a point: an array of another form is found by that, wherever it stands."""
    _check_size(part.get("size"))
    float(part.get("px_per_mm") or 0)
    with np.errstate(all="ignore"):
        mapped = from_dict(part["transform"])(np.array([[1.0, 2.0]]))
    if np.shape(mapped) != (1, 2):
        raise ValueError("a transform does not map points to points")
    if part.get("sigma") is not None:
        Sigma.from_dict(part["sigma"])(np.zeros((1, 2)))


def _check_size(size: Any) -> None:
    if size is not None and not (
        len(size) == 2 and all(isfinite(n) and 0 < n <= MOST_PX for n in size)
    ):
        raise ValueError("a size is not two numbers of pixels")


CHECKS: dict[str, Check] = {
    **dict.fromkeys(
        ("object", "camera", "setup"), ((str,), lambda name: check_plain_names(name or "-"))
    ),
    "method": ((str,), str),
    "reference": ((dict, str), _check_frame),
    "target": ((dict, str), _check_frame),
    "grid": ((dict,), _check_map),
    "verdict": ((dict,), _check_verdict),
    "model": ((dict,), lambda part: object_outline({"model": part})),
    "trace": ((dict,), lambda part: beyond_checks({"trace": part}, np.zeros((1, 2)))),
    "bands": ((dict,), dict),
    "errors": ((dict,), _check_errors),
    "pairs_by_hand": ((int,), int),
    "tiles": ((dict,), dict),
    "placement": ((dict,), dict),
}
"""How the parts of a record are checked, where they are there."""


def describe_pairs(record: Mapping[str, Any]) -> str:
    """Return how many pairs by hand a layer was aligned with, or placed by, in words; empty where there are none.

    >>> describe_pairs({"pairs_by_hand": 4, "verdict": {"decision": "accept"}})
    'aligned with 4 pairs by hand'
    """
    verdict = record.get("verdict") or {}
    if verdict.get("decision") == "refuse":
        return ""
    numbers = (verdict.get("numbers") or {}).values()
    placed = [n["placed_by_hand"] for n in numbers if isinstance(n, dict) and "placed_by_hand" in n]
    if placed:
        return describe_placement(max(placed, key=lambda one: one["fit_px"] or 0.0))
    count = record.get("pairs_by_hand", 0)
    return f"aligned with {counted(count, 'pair')} by hand" if count else ""


def digest_of_map(record: Mapping[str, Any]) -> str:
    """Return a digest of a layer's maps, by six digits of every number: a thousandth of a pixel is nothing."""
    parts = [record, *(record.get("tiles") or {}).values()]
    maps = [
        {k: band.get("transform") for k, band in part.get("bands", {}).items()} for part in parts
    ]
    text = NUMBER.sub(lambda found: f"{float(found[0]):.6g}", json.dumps(maps, sort_keys=True))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def apply_confirmation(record: Mapping[str, Any], word: Any) -> dict[str, Any]:
    """Return the verdict of a record with a person's word on it, as edits hold it, or None: a doubtful layer is accepted while it has the map that was looked at."""
    verdict = dict(record["verdict"])
    verdict |= verdict.pop("confirmed", {}).get("program", {})
    lapsed = word is not None and word.map != digest_of_map(record)
    if word is None or verdict["decision"] not in ("warn", *(["refuse"] if lapsed else [])):
        return verdict
    program = {key: verdict[key] for key in ("decision", "reasons", "next_step")}
    if lapsed:
        text = f"{word.name} accepted another map, {word.date}: that has lapsed."
        verdict["reasons"] = [text, *program["reasons"]]
    else:
        doubts = f"The program: doubtful, because {' '.join(program['reasons'])}"
        reasons = [f"Accepted by {word.name}, {word.date}: {word.words}", doubts]
        verdict |= {"decision": "confirmed", "reasons": reasons, "next_step": ""}
    return verdict | {"confirmed": {**dict(word), "lapsed": lapsed, "program": program}}


def describe_lying(record: Mapping[str, Any]) -> list[str]:
    """Return in words that the object does not stand upright: files of the reference camera are turned, and the grid is not."""
    orientation = (record.get("target") or {}).get("orientation")
    if orientation is None or record["camera"] != record["reference"]["camera"] or record["setup"]:
        return []
    slope = _slope(record["grid"])
    if np.diag(slope).min() <= 0 or abs(slope[0, 1]) > 0.1 * slope[0, 0]:
        return []  # a person turned it, this way or another
    keys = ", ".join(f"{k} = {json.dumps(v)}" for k, v in grid_keys(orientation).items())
    turned = f"viewers show this file {describe_turn(orientation)} (EXIF orientation {orientation})"
    return [f"{turned}, and the grid is not turned. Write {keys} under [grid], and build again."]


def _slope(grid: Mapping[str, Any]) -> np.ndarray:
    """Reference px a pixel of the grid, (2, 2)."""
    return np.asarray(from_dict(grid["transform"]).jacobian(np.zeros((1, 2)))[0])


def unchecked_share(record: Mapping[str, Any], key: str = "unchecked") -> float:
    """Return the share of a layer, 0 … 1, where nothing confirms its map; 0 where a record has none. ``"outside"``: the part outside the object's outline."""
    share = (record.get("verdict") or {}).get(key)
    if isinstance(share, bool) or not isinstance(share, int | float):
        return 0.0
    return float(share) if 0 <= share <= 1 else 0.0


def unchecked_mm2(record: Mapping[str, Any]) -> float | None:
    """Return the same as an area, mm²; None where the sampling is not known."""
    scale, (width, height) = record["grid"].get("px_per_mm"), record["grid"]["size"]
    return float(unchecked_share(record) * width * height / scale**2) if scale else None


def mm_per_px(record: Mapping[str, Any]) -> float | None:
    """Return mm on the object a pixel of the reference, None where the sampling is not known."""
    grid, scale = record["grid"], record["grid"].get("px_per_mm")
    return float(1 / (scale * abs(np.linalg.det(_slope(grid))) ** 0.5)) if scale else None


def with_size(record: Mapping[str, Any], size_mm: Sequence[float] | None) -> dict[str, Any]:
    """Return a record with the object's size, (width, height) mm, and the sampling that follows from it, grid px per mm.

    The sampling is None where the size or the object's sides are not known, or are not of one thing. The longer sides
    belong together, however the object lies in the frame.

    >>> from levkas.geometry.transforms import Affine
    >>> grid = {"transform": Affine.scaling(2.0).to_dict(), "object_px": [1188.0, 1500.0]}
    >>> sized = [with_size({"grid": grid}, (733.3, side))["grid"] for side in (925.9, 733.0)]
    >>> round(sized[0]["px_per_mm"], 3), sized[1]["px_per_mm"]
    (0.81, None)
    """
    if "grid" not in record:  # a refused mosaic has no frame
        return dict(record)
    grid, sampling = record["grid"], None
    if size_mm and grid["object_px"]:
        scales = np.sort(grid["object_px"]) / np.sort(size_mm)
        if 0 < scales.max() <= MOST_UNLIKE * scales.min():
            sampling = float(np.sqrt(scales.prod() / abs(np.linalg.det(_slope(grid)))))
    size = None if size_mm is None else list(size_mm)
    return {**record, "grid": {**grid, "size_mm": size, "px_per_mm": sampling}}


def describe_size(record: Mapping[str, Any]) -> list[str]:
    """Return in words why an object's size gives no sampling, where it gives none."""
    grid = record.get("grid") or {}
    if not grid.get("size_mm") or grid["px_per_mm"]:
        return []
    (width, height), sides = grid["size_mm"], grid["object_px"]
    why = "no edge of the object is visible"
    if sides:
        shape = f"{sides[0]:.0f} x {sides[1]:.0f} px"
        why = f"its outline, {shape}, has not the shape of {width:g} x {height:g} mm"
    name = json.dumps(record["object"], ensure_ascii=False)
    return [
        f"lengths in mm are not known: {why}. Draw the outline of what size_mm is of in the workbench, "
        f"or write outline = [[x, y], …], px of the reference band, under [objects.{name}]."
    ]


def unconfirmed_cells(record: Mapping[str, Any]) -> list[list[float]]:
    """Return the cells, (x, y, width, height) in reference px, where nothing confirms a layer's map, or it is off."""
    numbers = record.get("verdict", {}).get("numbers") or {}
    sensors = [n for n in numbers.values() if isinstance(n, dict)]
    return [
        [float(value) for value in cell[:4]]
        for part in sensors
        for key in ("unsupported", "off")
        for cell in part.get(key) or ()
    ]


def object_outline(record: Mapping[str, Any]) -> np.ndarray:
    """Return the corners of the object's outline, (n, 2) reference px; none where the whole frame is the object."""
    mask = (record.get("model") or {}).get("mask") or {}
    return np.array(mask.get("outline") or (), float).reshape(-1, 2)


def beyond_checks(record: Mapping[str, Any], points: np.ndarray) -> np.ndarray:
    """Return which points, (n, 2) reference px, nothing confirms: outside the object's outline, or too far from windows that agree."""
    outline = object_outline(record)
    lost = ~contains(outline, points) if len(outline) else np.zeros(len(points), bool)
    for sensor in (record.get("trace") or {}).get("sensors") or ():
        if checks := sensor.get("checks"):
            rest = np.flatnonzero(~lost)
            lost[rest] = CheckWindows.from_dict(checks).beyond(points[rest]) > 0
    for left, top, width, height in unconfirmed_cells(record):
        apart = points - (left, top)
        lost |= ((apart >= 0) & (apart < (width, height))).all(1)
    return lost


def shares_light(record: Mapping[str, Any], wavelengths: Iterable[float]) -> bool:
    """Return whether a layer can be compared with the reference by likeness (SSIM).

    An X-ray cannot: where none of its bands has a wavelength, nm, it must show the detail of a colour camera.
    """
    known = [isfinite(wavelength) for wavelength in wavelengths]
    sensors = (record.get("errors") or {}).get("sensors") or {}
    judged = [sensor["alike"] for sensor in sensors.values() if "alike" in sensor]
    return any(known) or (any(judged) if judged else len(known) >= 3)
