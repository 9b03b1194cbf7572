"""A campaign that was read from campaign.toml, every key checked."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

from pydantic import ValidationError

from levkas.campaign.edits import FILE_NAME, Edits, read_edits
from levkas.campaign.schema.cross_checks import (
    find_contradictions,
    find_ineffective,
    without_effect,
)
from levkas.campaign.schema.error_messages import MOST_PROBLEMS, explain, left_out
from levkas.campaign.schema.tables import (
    PLAN,
    REGISTER,
    CameraKeys,
    Document,
    ReferenceKeys,
)
from levkas.campaign.schema.toml import TomlRefused, read_toml
from levkas.core.problems import Problem, Refused
from levkas.core.text import missing_path
from levkas.registration.methods import method_of

__all__ = ["Camera", "Campaign", "CampaignInvalid", "campaign_of", "load_campaign"]


EXPLAINED = "docs/campaign.md explains every key."
ATTEMPTS = 4
"""Rounds of leaving out what is wrong, until the rest can be checked against itself."""


class CampaignInvalid(Refused):
    """campaign.toml cannot be used; every reason is listed."""


class Camera(CameraKeys):
    """One camera with its name."""

    name: Annotated[str, PLAN]


class Campaign(Document):
    """A campaign that was read: its document, its folder, its corrections.

    Attributes
    ----------
    path, root : Path
        campaign.toml, and its folder, to which all names in it are relative.
    edits : Edits
        Corrections by hand, of edits.toml beside it.
    """

    path: Path
    root: Path
    cameras: dict[str, Camera]  # type: ignore[assignment]
    edits: Annotated[Any, REGISTER] = Edits()

    @property
    def output(self) -> Path:
        """The database's folder."""
        return (self.root / self.campaign.output).resolve()

    @property
    def reference(self) -> ReferenceKeys:
        """The band that all others are registered to."""
        return self.campaign.reference

    def registration_of(self, camera: str) -> dict[str, Any]:
        """Registration keys for one camera: its own over the campaign's, those of its method only."""
        keys = {**self.registration.declared(), **self.cameras[camera].registration.declared()}
        own = {"method", *method_of(keys).options.model_fields}
        return {key: value for key, value in keys.items() if key in own}

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Keys of campaign.toml and edits.toml that no build heeds, one sentence each."""
        warnings = list(find_ineffective(self))
        for (name, frame), edits in sorted(self.edits.frames.items()):
            camera = re.split("[@:#]", frame)[0]
            if camera not in self.cameras:
                continue
            if self.cameras[camera].has_tiles and "#" not in frame:
                warnings.append(
                    f"{FILE_NAME}: corrections of {name}/{frame} have no effect: name one of its tiles, as in {camera}#r1c2"
                )
                continue
            ineffective = method_of(self.registration_of(camera)).ineffective
            if ineffective:
                where = f'objects."{name}".cameras."{frame}"'
                given = [
                    key for key in sorted(ineffective) if getattr(edits, key, None) is not None
                ]
                warnings += [f"{FILE_NAME}: {without_effect(f'{where}.{key}')}" for key in given]
        return tuple(warnings)

    def outline_of(self, name: str) -> tuple[tuple[tuple[float, float], ...], str]:
        """Return the declared outline of an object, reference px, and which file declares it; nothing and "" where none does.

        edits.toml goes before campaign.toml.
        """
        if corners := self.edits.outlines.get(name):
            return corners, FILE_NAME
        facts = self.objects.get(name)
        corners = (facts.outline if facts else None) or ()
        return corners, self.path.name if corners else ""

    def darks_of(self, camera: Camera) -> tuple[str, ...]:
        """Values of {target} that are darks of a camera; none for a plain image."""
        if not camera.traits.is_calibrated:
            return ()
        return camera.dark if camera.dark is not None else self.targets.dark

    def whites_of(self, camera: Camera) -> tuple[str, ...]:
        """Values of {target} that are whites of a camera; none for a plain image."""
        if not camera.traits.is_calibrated:
            return ()
        if camera.white_names is not None:
            return camera.white_names
        return self.targets.white.names if self.targets.white else ()


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign.

    Parameters
    ----------
    path : path
        A folder that holds campaign.toml, or the file itself.

    Returns
    -------
    campaign : Campaign
        Its keys as attributes, defaults filled in; no frame is read.

    Raises
    ------
    CampaignInvalid
        With every problem of the file: key, what was found, what is expected.
    EditsInvalid
        The same of edits.toml beside it, where there is one.

    Examples
    --------
    `plates` is the folder of a campaign of one object, a photograph and an infrared picture.

    >>> campaign = load_campaign(plates)
    >>> list(campaign.cameras), campaign.reference.band
    (['photo', 'infrared'], 'G')
    """
    path = Path(path)
    path = path / "campaign.toml" if path.is_dir() else path
    try:
        path = path.resolve()
    except (OSError, RuntimeError):  # a link that leads to itself: the reading refuses it
        path = path.absolute()
    try:
        record = read_toml(path)
    except TomlRefused as refused:
        missing = refused.problems[0].found == "no such file"
        fix = (
            "Give the folder of a campaign. For a folder of raw frames, `levkas look FOLDER "
            "--write` proposes a campaign.toml. docs/campaign.md explains every key."
            if missing
            else None
        )
        problems = [replace(p, fix=fix or p.fix) for p in refused.problems]
        if missing:
            in_folder = path.name == "campaign.toml" and path.parent.is_dir()
            found = "a folder without campaign.toml" if in_folder else "no such folder"
            message = "no campaign was found here"
            folder = path.parent if path.name == "campaign.toml" else path
            near = missing_path(folder)
            if near is not None and near.fix and near.fix.startswith("Did"):
                fix = near.fix
            problems = [replace(p, message=message, found=found, fix=fix) for p in problems]
        raise CampaignInvalid(*problems) from None
    document, problems = _validate(path, record)
    if document is None or problems:
        raise CampaignInvalid(*dict.fromkeys(problems))
    return campaign_of(document, path, read_edits(path.parent / FILE_NAME))


def campaign_of(document: Document, path: Path, edits: Edits = Edits()) -> Campaign:  # noqa: B008
    """Return the campaign of a checked document whose campaign.toml is, or would be, at `path`."""
    cameras = {
        name: Camera.model_construct(name=name, **dict(keys))
        for name, keys in document.cameras.items()
    }
    fields = {**dict(document), "cameras": cameras}
    return Campaign.model_construct(**fields, path=path, root=path.parent, edits=edits)


def _validate(path: Path, record: dict[str, Any]) -> tuple[Document | None, list[Problem]]:
    """Check values key by key, then what is sound against one another."""
    problems: list[Problem] = []
    document, sound = None, record
    for attempt in range(ATTEMPTS):
        try:
            document = Document.model_validate(sound)
            break
        except ValidationError as invalid:
            errors = invalid.errors(include_url=False, include_context=False)
            if not attempt:
                problems = explain(record, errors)
            if len(errors) > MOST_PROBLEMS:
                break
            sound = _without(sound, errors)
    fields = {p.field or "" for p in problems}
    unsound = set(_cameras(record)) - set(_cameras(sound))
    found = find_contradictions(document, path.parent) if document else iter(())
    for problem in islice(found, MOST_PROBLEMS):
        again = any(_within(problem.field or "", field) for field in fields)
        if not again and problem.found not in unsound:
            problems.append(problem)
    if next(found, None) is not None:
        problems += left_out()
    return document, [replace(p, file=str(path), fix=p.fix or EXPLAINED) for p in problems]


def _cameras(record: dict[str, Any]) -> list[str]:
    cameras = record.get("cameras")
    return list(cameras) if isinstance(cameras, dict) else []


def _within(field: str, other: str) -> bool:
    """Whether two fields are one, or one is a table that holds the other."""
    a, b = f"{field}.", f"{other}."
    return a.startswith(b) or b.startswith(a)


def _without(record: dict[str, Any], errors: list[Any]) -> dict[str, Any]:
    """Return a copy of a record without what is wrong: a key, or a table that lacks one."""
    sound = dict(record)
    copied = {id(sound)}
    for error in errors:
        steps = [step for step in error["loc"] if not str(step).startswith("<")]
        steps = steps[:-1] if error["type"] == "missing" else steps
        if not steps:
            continue
        table: Any = sound
        for step in steps[:-1]:
            inner = table.get(step)
            if not isinstance(inner, dict):
                steps = [*steps[: steps.index(step)], step]  # a list is left out as a whole
                break
            if id(inner) not in copied:
                inner = table[step] = dict(inner)
                copied.add(id(inner))
            table = inner
        table.pop(steps[-1], None)
    return sound
