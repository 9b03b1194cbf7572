"""Evaluation of a whole database: every band of every layer against truth, points and SSIM."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.error_sources import COVERAGE
from levkas.core.problems import Problem, Refused, closest_match
from levkas.core.text import missing_path
from levkas.database.layout import Places, layer_name
from levkas.database.manifest import check_inside
from levkas.database.pixel_frames import warn_of_turns
from levkas.database.registrations import read_registration, read_registrations
from levkas.database.remote import is_remote, place
from levkas.geometry import from_dict
from levkas.quality.evaluation.similarity import (
    BandError,
    Truth,
    inside,
    places_by_tiles,
    position_errors,
    read_truth,
    summarise_errors,
    uncertainty_of_mean,
)
from levkas.registration.record import DECISIONS

if TYPE_CHECKING:
    Checks = dict[tuple[str, str, str], np.ndarray]


THINNED = 4
"""Every so-many-th pixel a side of a map of SSIM, which is even over 11 px, gives its uncertainty."""
AS_STORED = "Check that the points were read in the file as it is stored, without heeding its EXIF orientation."


class EvaluationRefused(Refused):
    """There is nothing here that can be evaluated."""


@dataclass(frozen=True)
class Assessment:
    """Results of each layer, as `evaluate --json` gives them, and problems."""

    results: list[dict[str, Any]]
    problems: list[Problem] = field(default_factory=list)

    @property
    def text(self) -> str:
        """A table for people: a line a layer, errors in reference pixels; means with expanded uncertainty."""
        head = f"{'layer':28} {'verdict':14} {'bands':>5} {'mean px':>15} {'worst band':>11} {'max px':>8} {'checks':>15} {'SSIM':>15}"
        lines = [head]
        for result in self.results:
            errors = [b for b in result["bands"] if b["error_mean"] is not None]
            worst = max((b["error_mean"] for b in errors), default=np.nan)
            most = max((b["error_max"] for b in errors), default=np.nan)
            ssim = _with_u(result["ssim"], result["ssim_u"])
            verdict = DECISIONS.get(result["verdict"], result["verdict"]).partition(",")[0]
            lines.append(
                f"{result['layer']:28} {verdict:14} {len(result['bands']):5d} "
                f"{_mean_error(errors):>15} {_number(worst):>11} {_number(most):>8} {_mean_error(result['check_points']):>15} {ssim:>15}"
            )
        if any("±" in line for line in lines):
            lines.append(
                f"± is the expanded uncertainty of a mean, k = {COVERAGE:g}: how far it may be off what such a picture has everywhere."
            )
        if not any(
            r["check_points"] or any(b["error_mean"] is not None for b in r["bands"])
            for r in self.results
        ):
            lines.append(
                "No truth and no check points: the table has no errors. The reports have held-out errors."
            )
        return "\n".join(lines)


def _mean_error(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the mean error of bands of one picture, each by its points: what one is off they all are."""
    counts = np.array([row["points"] for row in rows], float)
    if not counts.sum():
        return "–"
    mean, u = (
        float(
            np.average([np.nan if row[key] is None else row[key] for row in rows], weights=counts)
        )
        for key in ("error_mean", "error_mean_u")
    )
    return _with_u(mean, u)


def _with_u(value: float | None, u: float | None) -> str:
    """Return a number with its expanded uncertainty where that is known."""
    shown = _number(np.nan if value is None else value)
    return shown if u is None or not np.isfinite(u) else f"{shown} ± {COVERAGE * u:.3f}"


def _number(value: float) -> str:
    return "–" if not np.isfinite(value) else f"{value:.3f}"


def assess(
    database: str | Path,
    *,
    truth: str | Path | None = None,
    points: str | Path | None = None,
    frame: str | None = None,
) -> Assessment:
    """Evaluate every layer of a database.

    Parameters
    ----------
    database : path
        A database, or the campaign (folder or campaign.toml) that it was built from.
    truth : path, optional
        Folder ``truth`` of a simulated campaign; by default the one beside campaign.toml or
        beside the database.
    points : path, optional
        Check points: CSV with columns object, camera, band, reference_x, reference_y, x, y, or a
        file of any program that `levkas.registration.control_points` reads.
    frame : str, optional
        OBJECT/CAMERA[@SETUP][:BAND] that such a file is of; not needed where there is one layer.

    Returns
    -------
    assessment : Assessment
        `results`: a dict a layer with verdict, errors of every band in reference px, and SSIM, means with their standard
        uncertainties (``error_mean_u``, ``ssim_u``); `problems`: what could not be evaluated; `text`: a table.

    Raises
    ------
    EvaluationRefused
        Where there is no database, or the points cannot be read.

    Examples
    --------
    >>> found = assess(plates / "database")
    >>> [(one["layer"], one["verdict"]) for one in found.results]
    [('one/infrared', 'accept'), ('one/photo', 'accept')]
    """
    output, beside = locate(place(database))
    folder = find_truth(truth, beside) or beside / "truth"
    checks, problems = read_check_points(Path(points), output, frame) if points else ({}, [])
    records = (record for _, record in read_registrations(output))
    results = [_assess_layer(output, record, folder, checks) for record in records]
    return Assessment(results, problems)


def find_truth(truth: str | Path | None, beside: Path) -> Path | None:
    """Return the folder of a truth, as it is given, else the one of a campaign; None where that has none.

    Raises EvaluationRefused where the one that is given has none.
    """
    folder = Path(truth).resolve() if truth else beside / "truth"
    if (folder / "truth.json").is_file():
        return folder
    if truth is None:
        return None
    raise EvaluationRefused(
        Problem(
            "E_UNREADABLE",
            "there is no truth in this folder",
            file=str(folder),
            expected="truth.json and OBJECT_CAMERA_px.npy",
            fix="Give the folder `truth` of a simulated campaign.",
        )
    )


def locate(path: Path) -> tuple[Path, Path]:
    """Return (database, folder where its truth may lie) for a database or a campaign."""
    if (path / "catalogue.csv").is_file():
        return path, path.parent
    if not is_remote(path) and (path.name == "campaign.toml" or (path / "campaign.toml").is_file()):
        from levkas.campaign.campaign import load_campaign

        campaign = load_campaign(path)
        if (campaign.output / "catalogue.csv").is_file():
            return campaign.output, campaign.root
        path = campaign.output
    elif not is_remote(path) and (absent := missing_path(path)) is not None:
        raise EvaluationRefused(absent)
    raise EvaluationRefused(
        Problem(
            "E_UNREADABLE",
            "no database was found here",
            file=str(path),
            expected="a folder with catalogue.csv",
            fix="Build the campaign first: levkas build CAMPAIGN.",
        )
    )


def read_check_points(
    path: Path, database: Path, frame: str | None = None
) -> tuple[Checks, list[Problem]]:
    """Read check points: {(object, layer, band): (n, 4) of reference x, y and native x, y}.

    Parameters
    ----------
    path : Path
        A CSV with columns object, camera, band, reference_x, reference_y, x, y, or a file of a
        program that `levkas.registration.control_points` reads.
    frame : str, optional
        OBJECT/CAMERA[@SETUP][:BAND] of such a file.
    """
    from levkas.registration.control_points import PointsRefused, read_frames

    known = {
        (str(record["object"]), file.stem): tuple(map(str, record.get("bands", ())))
        for file, record in read_registrations(database)
    }
    try:
        found = read_frames(path, frame, known)
    except PointsRefused as refused:
        raise EvaluationRefused(*refused.problems) from None
    problems = [p for key in found if (p := _unknown_frame(key, known, path))]
    turned = _turned_frames(found, path, database)
    checks = {
        (name, layer, band): np.hstack([points.reference, points.target])[points.enabled]
        for (name, layer, band), points in found.items()
        if (name, layer) in known and band in ("", *known[name, layer])
    }
    if problems and not checks:
        raise EvaluationRefused(*problems[:10])
    return checks, [*problems[:10], *turned]


def _turned_frames(
    found: Iterable[tuple[str, str, str]], path: Path, database: Path
) -> list[Problem]:
    """Return a problem for each layer, or reference of one, whose file viewers turn: points may be read in such a one."""
    turned: dict[str, Problem] = {}
    for name, layer in dict.fromkeys((name, layer) for name, layer, _ in found):
        leading = {
            r["reference"]["camera"]
            for p, r in read_registrations(database, name)
            if p.stem == layer
        }
        for text in warn_of_turns(database, name, (layer, *leading)) if leading else ():
            turned.setdefault(text, Problem("E_TURNED", text, str(path), fix=AS_STORED))
    return list(turned.values())


def _unknown_frame(
    key: tuple[str, str, str], known: Mapping[tuple[str, str], tuple[str, ...]], path: Path
) -> Problem | None:
    """Return the problem of points of a layer or band that the database does not have."""
    name, layer, band = key
    bands = known.get((name, layer))
    if bands is not None and band in ("", *bands):
        return None
    there = ["/".join(one) for one in known] if bands is None else list(bands)
    what, meant = ("layer", f"{name}/{layer}") if bands is None else ("band", band)
    return Problem(
        "E_VALUE",
        f"the points of {name}/{layer}{f':{band}' if band else ''} are not used: no such {what}",
        str(path),
        "object, camera, band",
        meant,
        ", ".join(there[:20]),
        closest_match(meant, there),
    )


def checks_by_band(
    checks: Mapping[tuple[str, str, str], np.ndarray], record: dict[str, Any], layer: str
) -> dict[str, np.ndarray]:
    """Return check points of a layer by band, (n, 4) each; those of no band are of the camera's reference channel."""
    channel = str((record.get("target") or {}).get("band", ""))
    found: dict[str, np.ndarray] = {}
    for (name, here, band), pairs in checks.items():
        if (name, here) == (record["object"], layer):
            label = band or channel
            found[label] = np.concatenate([found[label], pairs]) if label in found else pairs
    return found


def _assess_layer(
    output: Path, record: dict[str, Any], truth_folder: Path, checks: Checks
) -> dict[str, Any]:
    name, camera, setup = record["object"], record["camera"], record.get("setup", "")
    layer = layer_name(camera, setup)
    decision = record["verdict"]["decision"]
    places = _places(output, record, truth_folder)
    truth = read_truth(truth_folder, name, camera, places)
    own = checks_by_band(checks, record, layer)
    tiles = _tile_errors(record, truth_folder, places)
    bands = [
        _over_tiles(label, tiles)
        if tiles
        else _band_error(label, band, record, truth, own.get(label))
        for label, band in record.get("bands", {}).items()
    ]
    ssim = layer_ssim(output, record) if decision != "refuse" else None
    return {
        "object": name,
        "camera": camera,
        "setup": setup,
        "layer": f"{name}/{layer}",
        "verdict": decision,
        "bands": [b.to_dict() for b in bands],
        "check_points": _checked(record, own),
        "ssim": ssim and ssim[0],
        "ssim_u": ssim and ssim[1],
        "method": record.get("method", ""),
    }


def _places(output: Path, record: dict[str, Any], folder: Path) -> np.ndarray | None:
    """Return where the points of the truth lie in reference px where the reference camera has tiles; None where it has none."""
    path = Places(output).registration(record["object"], record["reference"]["camera"])
    reference = read_registration(path) if path.is_file() else {}
    return places_by_tiles(folder, record["object"], reference) if reference.get("tiles") else None


Errors = dict[str, tuple[np.ndarray, np.ndarray]]
"""By band: errors, (n,), and their places, (n, 2), reference px."""


def _tile_errors(
    record: dict[str, Any], folder: Path, places: np.ndarray | None
) -> dict[str, Errors]:
    """Return the errors of every tile that is placed and has a truth, by tile and band."""
    found: dict[str, Errors] = {}
    for tile, one in record.get("tiles", {}).items():
        truth = read_truth(folder, record["object"], f"{record['camera']}#{tile}", places)
        if truth is None or not one.get("bands"):
            continue
        found[tile] = {}
        for label, band in one["bands"].items():
            reference, target = truth.reference, truth.bands[label]
            keep = np.isfinite(reference).all(1) & inside(target, band["size"])
            grid = from_dict(record["grid"]["transform"]).inverse(reference[keep])
            keep[keep] = inside(grid, record["grid"]["size"])
            errors = position_errors(from_dict(band["transform"]), reference[keep], target[keep])
            found[tile][label] = errors, reference[keep]
    return found


def _over_tiles(label: str, tiles: Mapping[str, Errors]) -> BandError:
    errors, places = zip(*(one[label] for one in tiles.values() if label in one), strict=True)
    return summarise_errors(label, np.concatenate(errors), np.concatenate(places))


def _checked(record: dict[str, Any], own: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Errors at check points: those of the evaluation, and those that the campaign named."""
    bands = record.get("bands", {})
    found = []
    for label, pairs in own.items():
        if label in bands:
            errors = position_errors(
                from_dict(bands[label]["transform"]), pairs[:, :2], pairs[:, 2:]
            )
            summary = summarise_errors(label, errors, pairs[:, :2])
            found.append({"of": "evaluation", **summary.to_dict()})
    declared: dict[str, list[tuple[float, float, float]]] = {}
    for one in (record.get("errors") or {}).get("check_points", []):
        error = np.nan if one["error"] is None else one["error"]
        declared.setdefault(one["band"], []).append((error, *one["reference"]))
    for label, rows in declared.items():
        errors, places = np.split(np.array(rows, float), [1], axis=1)
        summary = summarise_errors(label, errors[:, 0], places)
        found.append({"of": "campaign", **summary.to_dict()})
    return found


def _band_error(
    label: str,
    band: dict[str, Any],
    record: dict[str, Any],
    truth: Truth | None,
    check: np.ndarray | None,
) -> BandError:
    """Errors of one band at the points that lie on the grid: all of the truth, else the check points."""
    transform = from_dict(band["transform"])
    if truth is not None and label in truth.bands:
        reference, target = truth.reference, truth.bands[label]
    elif check is not None:
        reference, target = check[:, :2], check[:, 2:]
    else:
        return summarise_errors(label, np.array([]), np.zeros((0, 2)))
    on_grid = inside(
        from_dict(record["grid"]["transform"]).inverse(reference), record["grid"]["size"]
    )
    keep = on_grid & np.isfinite(target).all(1) & inside(target, band["size"])
    errors = position_errors(transform, reference[keep], target[keep])
    return summarise_errors(label, errors, reference[keep])


def layer_ssim(output: Path, record: dict[str, Any]) -> tuple[float, float] | None:
    """Return the SSIM of one published layer against the reference camera's, and its standard uncertainty; None where there is none."""
    from levkas.quality.evaluation.similarity import structural_similarity

    reference, ours = record["reference"], _grey(output, record["object"], record)
    base = _grey(output, record["object"], {"camera": reference["camera"], "setup": ""})
    if ours is None or base is None:
        return None
    score, full = structural_similarity(base[0], ours[0], base[1] & ours[1])
    if np.isnan(score):
        return None
    some = full[::THINNED, ::THINNED]
    rows, columns = np.nonzero(np.isfinite(some))
    return score, uncertainty_of_mean(some[rows, columns], np.stack([columns, rows], 1))


def _grey(output: Path, name: str, record: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean of the registered bands, and the pixels that every band saw."""
    from levkas.database.grey import read_grey

    path = Places(output).layer(name, record["camera"], record.get("setup", ""))
    check_inside(output, path, path.with_name(f"{path.stem}.flags.tif"))
    return read_grey(path) if path.is_file() else None
