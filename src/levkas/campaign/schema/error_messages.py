"""Turn findings of the schema into problems in our words, with the closest known key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel

from levkas.campaign.camera_kinds import KINDS
from levkas.campaign.schema.tables import Document
from levkas.core.problems import Problem, closest_match
from levkas.core.requirements import requirement

MOST_PROBLEMS = 100
"""Problems that one report lists; a file with more is probably another kind of file."""
EXAMPLES = {
    "reference": '{ camera = "lctf-vis", band = "550 nm" }',
    "kind": ", ".join(KINDS),
    "campaign": "a table [campaign] with `reference`",
    "cameras": "a table [cameras.NAME] for each camera",
}

IN_A_FILE = 'Write the pairs of the matcher into a CSV: points = "pairs.csv", use = "start".'
ALONE = "Take it out: every capture is registered by itself."
GONE = {
    "cameras.*.isos": "Leave it out: a plan is for one ISO, the lowest.",
    "cameras.*.read_after_e": "Leave it out: `read_e` is the whole read noise at the lowest ISO.",
    "cameras.*.sure": "Leave it out: no unit is asked about any more.",
    "lamps.*.flicker": "Leave it out: let exposures last many periods of the mains.",
    "lamps.*.lobe": "Write beam_deg, the half-width at half intensity, in its place.",
    "object.bend": "Leave it out: a panel is flat here; a bend moves the best lamps by less than 1°.",
    "object.sure": "Leave it out: no unit is asked about any more.",
    "room": "Leave it out: lamps are turned about the object where they stand.",
    "setups.*.lamps.*.sure": "Leave it out: no unit is asked about any more.",
    "target.flicker": "Leave it out: let exposures last many periods of the mains.",
    "target.least_snr": "Leave it out: the plan shows the SNR of every channel.",
    "registration.joint": ALONE,
    "registration.starts": IN_A_FILE,
    "cameras.*.registration.starts": IN_A_FILE,
    "cameras.*.registration.joint": ALONE,
    "cameras.*.level_tiles": "Leave it out: steps between tiles are measured and shown; mend the light or the white.",
    "cameras.*.stray_light": "Nothing takes stray light off: state it as uncertainty = { stray_light = 0.01 }.",
}
"""Keys that Levkas had once, a name of the campaign's as `*`, and what to write in their place."""


def explain(
    record: dict[str, Any], errors: Sequence[Any], document: type[BaseModel] = Document
) -> list[Problem]:
    """Return the problems that findings of the schema mean, of very many the first ones.

    Parameters
    ----------
    record : dict
        What was read.
    errors : sequence
        As pydantic's `ValidationError.errors` gives them.
    document : type
        The schema they were found by.
    """
    listed = errors[:MOST_PROBLEMS]
    problems = _without_echoes([_problem(record, e, document) for e in listed])
    return [*problems, *left_out(len(errors) - len(listed))]


def left_out(count: int | None = None) -> list[Problem]:
    """Return what ends a list that was cut short; nothing where `count` is 0."""
    if count == 0:
        return []
    how_many = "more" if count is None else f"{count} more"
    fix = "Correct those above first. Is it the right file?"
    return [Problem("E_TOO_MANY", f"{how_many} problems are not listed", fix=fix)]


def _problem(record: dict[str, Any], error: Any, document: type[BaseModel]) -> Problem:
    """Turn one finding of the schema into a problem, with the key that was meant."""
    where = [step for step in error["loc"] if not str(step).startswith("<")]
    field, key = _named(record, where), str(where[-1])
    if isinstance(where[-1], int):
        key = f"item {where[-1] + 1} of {next(s for s in reversed(where) if isinstance(s, str))}"
    if error["type"] == "extra_forbidden":
        if fix := _gone(where):
            return Problem("E_KEY", f"there is no key {key!r} any more", field=field, fix=fix)
        known = _known_keys(where[:-1], document)
        open_ = [k for k in known if k not in _at(record, where[:-1])]
        elsewhere = [f"[{table}]" for table, keys in _tables(document, "").items() if key in keys]
        near = closest_match(key, open_) or closest_match(key, known)
        home = f"It belongs to {' or '.join(elsewhere)}." if elsewhere else "Take it out."
        return Problem(
            "E_KEY",
            f"unknown key {key!r}",
            field=field,
            expected=", ".join(known),
            fix=near or home,
        )
    if error["type"] == "missing":
        return Problem("E_KEY", f"{key} is required", field=field, expected=EXAMPLES.get(key))
    message = str(error["msg"])
    found = error.get("input")
    shown = "a table" if isinstance(found, dict) else str(found)[:80]
    return Problem("E_VALUE", f"{key} {requirement(message)}", field=field, found=shown)


def _gone(where: Sequence[int | str]) -> str:
    """Return what to write in place of a key that Levkas had once; empty of any other."""
    for place, fix in GONE.items():
        steps = place.split(".")
        if len(steps) == len(where) and all(
            a in ("*", b) for a, b in zip(steps, where, strict=True)
        ):
            return fix
    return ""


def _without_echoes(problems: list[Problem]) -> list[Problem]:
    """Leave out required keys that are only misspelt."""
    spelt = {(_table(p), p.fix) for p in problems if p.fix}
    return [
        p
        for p in problems
        if not p.message.endswith(" is required")
        or (_table(p), f"Did you mean {(p.field or '').rpartition('.')[2]!r}?") not in spelt
    ]


def _table(problem: Problem) -> str:
    return (problem.field or "").rpartition(".")[0]


def _at(record: dict[str, Any], where: list[int | str]) -> Any:
    """Return the table at a place of a record."""
    place: Any = record
    for step in where:
        place = place[step]
    return place


def _named(record: dict[str, Any], where: list[int | str]) -> str:
    """Return the dotted name of a key; an item of a list of tables by its name."""
    names, place = [], record
    for step in where:
        inner: Any = None
        if isinstance(place, dict):
            inner = place.get(str(step))
        elif isinstance(place, list) and isinstance(step, int) and step < len(place):
            inner = place[step]
        named = isinstance(step, int) and isinstance(inner, dict)
        names.append(str(inner.get("name", step)) if named else str(step))
        place = inner
    return ".".join(names)


def _known_keys(where: list[int | str], document: type[BaseModel]) -> list[str]:
    """Return the keys of the schema at a place such as ``["cameras", "nir"]``."""
    model: Any = document
    is_name = False
    for step in where:
        field = None if is_name else model.model_fields.get(str(step))
        is_name = field is not None and _is_dict(field)
        model = (_model_in(field.annotation) if field else None) or model
    return sorted(model.model_fields)


def _is_dict(field: Any) -> bool:
    return getattr(field.annotation, "__origin__", None) is dict


def _model_in(annotation: Any) -> Any:
    """Return the table inside an annotation such as ``dict[str, Camera]`` or ``GridKeys | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_model_in(part) for part in getattr(annotation, "__args__", ()))
    return next((model for model in inner if model), None)


def _tables(model: Any, name: str) -> dict[str, tuple[str, ...]]:
    tables = {name: tuple(model.model_fields)} if name else {}
    for key, field in model.model_fields.items():
        inner = _model_in(field.annotation)
        if inner:
            place = f"{name}.{key}".lstrip(".")
            tables |= _tables(inner, f"{place}.NAME" if _is_dict(field) else place)
    return tables


TABLES = _tables(Document, "")
"""Known keys by table: ``"cameras.NAME"``, ``"cameras.NAME.registration"``, …"""
