"""campaign.toml: what was captured, by what, and what is wanted; every key strict and documented."""

from __future__ import annotations

import datetime
import difflib
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from levkas.problems import Problem, Refused

LARGEST_FILE = 1 << 20
LONGEST_LINE = 64 << 10
DEEPEST_KEY = 12
NAME = re.compile(r"[\w][\w.\- ]{0,79}")


class CampaignInvalid(Refused):
    """campaign.toml cannot be used; every reason is listed."""


class Strict(BaseModel):
    """A table of which every key is known."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, arbitrary_types_allowed=True
    )


def _names(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


def _text_date(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime.date | datetime.datetime) else value


def _pattern(value: Any) -> Any:
    """Bring ``"RGGB"`` or rows of names into rows of names."""
    if isinstance(value, str):
        if not re.fullmatch(r"[RGBM]{4}", value.upper()):
            raise ValueError('a pattern is four letters such as "RGGB", or rows of channel names')
        letters = value.upper()
        return ((letters[0], letters[1]), (letters[2], letters[3]))
    rows = (
        tuple(tuple(str(n) for n in row) for row in value)
        if isinstance(value, list | tuple)
        else ()
    )
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError(
            'a pattern is four letters such as "RGGB", or rows of equally many channel names'
        )
    return rows


Names = Annotated[tuple[str, ...], BeforeValidator(_names)]
Date = Annotated[str | None, BeforeValidator(_text_date)]
Pattern = Annotated[
    tuple[tuple[str, ...], ...] | None,
    BeforeValidator(lambda v: None if v is None else _pattern(v)),
]


class Range(Strict):
    """Wavelengths at equal steps, both ends included, nm."""

    start: float = Field(gt=0)
    stop: float = Field(gt=0)
    step: float = Field(gt=0)

    def values(self) -> tuple[float, ...]:
        """Return the wavelengths, nm.

        >>> Range(start=400, stop=420, step=10).values()
        (400.0, 410.0, 420.0)
        """
        count = round((self.stop - self.start) / self.step) + 1
        return tuple(round(self.start + i * self.step, 6) for i in range(count))

    @model_validator(mode="after")
    def _closes(self) -> Range:
        count = (self.stop - self.start) / self.step
        if count < 0 or abs(count - round(count)) > 1e-6:
            raise ValueError(
                f"{self.start:g} to {self.stop:g} nm is no whole number of steps of {self.step:g} nm"
            )
        return self


class Reference(Strict):
    """What all else is registered to."""

    camera: str
    band: str | None = None


class Description(Strict):
    """The campaign as a whole."""

    title: str = ""
    creator: str = ""
    date: Date = None
    licence: str = ""
    reference: Reference
    output: str = "database"

    @field_validator("reference", mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        if isinstance(value, str):
            camera, _, band = value.partition(":")
            return {"camera": camera, "band": band or None}
        return value


class GridKeys(Strict):
    """The published frame."""

    mirror: bool = False
    rotate: float = 0.0
    region: tuple[float, float, float, float] | Literal["auto"] | None = None
    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None

    @field_validator("region")
    @classmethod
    def _positive(cls, value: Any) -> Any:
        if isinstance(value, tuple) and (value[2] <= 0 or value[3] <= 0):
            raise ValueError("a region is [x, y, width, height] with width and height > 0")
        return value


class RegistrationKeys(Strict):
    """How cameras are registered; errors in reference pixels."""

    method: Literal["levkas", "mirhashemi2019"] | None = None
    reject: float | None = Field(default=None, gt=0)
    stop: float | None = Field(default=None, gt=0)
    ratio: float | None = Field(default=None, gt=0, le=1)
    order: int | None = Field(default=None, ge=1, le=5)

    def given(self) -> dict[str, Any]:
        """Return what was said, by key."""
        return {k: v for k, v in self.model_dump().items() if v is not None}


class Sensor(Strict):
    """One sensor of a multi-sensor camera."""

    name: str
    files: Names = ()
    pattern: Pattern = None
    bands: Names = ()
    align: Literal["measure"] | tuple[tuple[float, float, float], tuple[float, float, float]] = (
        "measure"
    )


class Camera(Strict):
    """One camera and how its files are named."""

    name: str = ""
    kind: Literal["mosaic", "bands", "sensors", "cube", "image"]
    files: Names = ()
    pattern: Pattern = None
    bands: Names | None = None
    wavelengths: tuple[float, ...] | Range | None = None
    sensitivity: str | None = None
    reference_band: str | None = None
    bits: int | None = Field(default=None, ge=1, le=32)
    black: float | None = None
    saturation: float | None = Field(default=None, gt=0)
    exposures: Literal["one", "best", "merge"] = "one"
    sensors: tuple[Sensor, ...] = ()
    scan: Literal["push-broom", "mirror"] | None = None
    denoise: Literal["hysime"] | None = None
    demosaic: Literal["malvar", "bilinear", "normalised"] | None = None
    dark: Names | None = None
    white: Names | None = None
    registration: RegistrationKeys = RegistrationKeys()

    @property
    def centres(self) -> tuple[float, ...] | None:
        """Declared wavelengths, nm."""
        return (
            self.wavelengths.values() if isinstance(self.wavelengths, Range) else self.wavelengths
        )

    @model_validator(mode="after")
    def _fits(self) -> Camera:
        if self.kind == "sensors":
            if not self.sensors:
                raise ValueError('kind "sensors" needs [[cameras.NAME.sensors]]')
            missing = [s.name for s in self.sensors if not s.files and not self.files]
            if missing:
                raise ValueError(f"sensor {missing[0]!r} has no files")
        elif self.sensors:
            raise ValueError('only kind "sensors" has [[cameras.NAME.sensors]]')
        elif not self.files:
            raise ValueError("files is required")
        if self.bands and self.centres and len(self.bands) != len(self.centres):
            raise ValueError(f"{len(self.bands)} bands and {len(self.centres)} wavelengths")
        return self


class White(Strict):
    """The white board."""

    names: Names
    reflectance: float | str | None = None


class TargetKeys(Strict):
    """What the values of {target} mean."""

    dark: Names = ()
    white: White | None = None
    charts: dict[str, str] = {}
    objects: Names | None = None

    @field_validator("white", mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        return {"names": value} if isinstance(value, str | list) else value


class SetupCamera(Strict):
    """A camera under another lighting."""

    files: Names


class Setup(Strict):
    """Another lighting."""

    cameras: dict[str, SetupCamera]


class ObjectFacts(Strict):
    """What a museum says of a painting."""

    title: str = ""
    creator: str = ""
    date: Date = None
    medium: str = ""
    size_mm: tuple[float, float] | None = None
    owner: str = ""
    rights: str = ""
    inventory: str = ""


class Document(Strict):
    """The whole of campaign.toml."""

    campaign: Description
    grid: GridKeys | None = None
    cameras: dict[str, Camera]
    targets: TargetKeys = TargetKeys()
    setups: dict[str, Setup] = {}
    objects: dict[str, ObjectFacts] = {}
    registration: RegistrationKeys = RegistrationKeys()


class Campaign(Document):
    """A campaign that was read: its document, and where it stands.

    Attributes
    ----------
    path, root : Path
        campaign.toml, and its folder, to which all names in it are relative.
    """

    path: Path
    root: Path

    @property
    def output(self) -> Path:
        """The database's folder."""
        return (self.root / self.campaign.output).resolve()

    @property
    def reference(self) -> Reference:
        """What all else is registered to."""
        return self.campaign.reference

    def registration_of(self, camera: str) -> dict[str, Any]:
        """Registration keys for one camera: its own over the campaign's."""
        return {**self.registration.given(), **self.cameras[camera].registration.given()}


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign.

    Parameters
    ----------
    path : path
        A folder that holds campaign.toml, or the file itself.

    Raises
    ------
    CampaignInvalid
        With every problem of the file: key, what was found, what is expected.
    """
    path = Path(path)
    path = (path / "campaign.toml" if path.is_dir() else path).resolve()
    record = _parse(path)
    try:
        document = Document.model_validate(record)
    except ValidationError as error:
        raise CampaignInvalid(*(_problem(path, e) for e in error.errors())) from None
    problems = list(_contradictions(path, document))
    if problems:
        raise CampaignInvalid(*problems)
    cameras = {
        name: camera.model_copy(update={"name": name}) for name, camera in document.cameras.items()
    }
    fields = {name: getattr(document, name) for name in type(document).model_fields}
    return Campaign.model_construct(
        **{**fields, "cameras": cameras, "path": path, "root": path.parent}
    )


def _parse(path: Path) -> dict[str, Any]:
    """Read TOML, its size and depth bounded before the parser sees it."""
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise CampaignInvalid(
                Problem(
                    "E_SIZE",
                    "the file is too large",
                    str(path),
                    found=f"{size} bytes",
                    expected=f"at most {LARGEST_FILE}",
                )
            )
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise CampaignInvalid(
            Problem(
                "E_UNREADABLE",
                "campaign.toml cannot be read",
                str(path),
                found=str(error),
                fix="Write one beside the raw frames; docs/campaign.md has every key.",
            )
        ) from error
    for number, line in enumerate(text.splitlines(), 1):
        deep = (
            line.split("=")[0].count(".") >= DEEPEST_KEY
            or max(line.count("["), line.count("{")) > 64
        )
        if len(line) > LONGEST_LINE or deep:
            raise CampaignInvalid(
                Problem(
                    "E_SIZE",
                    "a line is too long or nested too deeply",
                    str(path),
                    field=f"line {number}",
                    found=f"{len(line)} characters",
                    expected=f"at most {LONGEST_LINE}, {DEEPEST_KEY} levels",
                )
            )
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise CampaignInvalid(
            Problem(
                "E_VALUE",
                "campaign.toml is no valid TOML",
                str(path),
                found=str(error),
                fix="Mend that line.",
            )
        ) from error


def _problem(path: Path, error: Any) -> Problem:
    """Turn one finding of the schema into a problem, with the nearest known key where one is misspelt."""
    where = [
        str(p) for p in error["loc"] if not str(p).startswith(("function-", "tuple[", "literal["))
    ]
    field = ".".join(where)
    if error["type"] == "extra_forbidden":
        known = _known_keys(where[:-1])
        near = difflib.get_close_matches(where[-1], known, 1, 0.6)
        return Problem(
            "E_KEY",
            f"unknown key {where[-1]!r}",
            str(path),
            field=field,
            expected=", ".join(known) or None,
            fix=f"Did you mean {near[0]!r}?" if near else "Take it out.",
        )
    if error["type"] == "missing":
        return Problem("E_KEY", f"{where[-1]} is required", str(path), field=field)
    found = error.get("input")
    found = None if isinstance(found, dict) else str(found)[:80]
    message = str(error["msg"]).removeprefix("Value error, ")
    return Problem("E_VALUE", message, str(path), field=field, found=found)


def _known_keys(where: list[str]) -> list[str]:
    """Keys that the schema knows at a place such as ``["cameras", "nir"]``."""
    model: Any = Document
    for step in where:
        # A name that a user chose, or a place in a list, is no key of the schema.
        field = model.model_fields.get(step)
        inner = _models_in(field.annotation) if field else None
        model = inner or model
    return sorted(k for k in model.model_fields if k != "name" or model is Sensor)


def _models_in(annotation: Any) -> Any:
    """The model inside an annotation such as ``dict[str, Camera]`` or ``GridKeys | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for part in getattr(annotation, "__args__", ()):
        found = _models_in(part)
        if found is not None:
            return found
    return None


def _contradictions(path: Path, document: Document) -> Any:
    """Yield what the tables say against one another."""
    file, cameras = str(path), document.cameras
    where = f"one of {', '.join(cameras)}"
    if document.campaign.reference.camera not in cameras:
        yield Problem(
            "E_VALUE",
            "the reference camera is not declared",
            file,
            "campaign.reference.camera",
            document.campaign.reference.camera,
            where,
        )
    for setup, keys in document.setups.items():
        for camera in keys.cameras:
            if camera not in cameras:
                yield Problem(
                    "E_VALUE",
                    "a setup names a camera that is not declared",
                    file,
                    f"setups.{setup}.cameras.{camera}",
                    camera,
                    where,
                )
    named = [("cameras", n) for n in cameras] + [("setups", n) for n in document.setups]
    named += [("objects", n) for n in document.objects]
    for table, name in named:
        if not NAME.fullmatch(name) or name.endswith((".", " ")) or "@" in name or ":" in name:
            yield Problem(
                "E_VALUE",
                "this name cannot be part of a file name",
                file,
                f"{table}.{name}",
                name,
                "letters, digits, - and _",
            )
    known = document.targets.objects
    if known:
        for name in document.objects:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                yield Problem(
                    "E_VALUE",
                    "facts of an object that is not among targets.objects",
                    file,
                    f"objects.{name}",
                    name,
                    ", ".join(known),
                    f"Did you mean {near[0]!r}?" if near else None,
                )
    reflectance = document.targets.white.reflectance if document.targets.white else None
    if isinstance(reflectance, float | int) and not 0 < reflectance <= 1.5:
        yield Problem(
            "E_VALUE",
            "a white board cannot reflect this",
            file,
            "targets.white.reflectance",
            reflectance,
            "a share such as 0.98, or a CSV over wavelength",
        )
    for name, camera in cameras.items():
        for text in (*camera.files, *(f for s in camera.sensors for f in s.files)):
            if "{target}" not in text:
                yield Problem(
                    "E_VALUE",
                    "the pattern has no {target}",
                    file,
                    f"cameras.{name}.files",
                    text,
                    "a pattern such as raw/NAME/{target}/*.tif",
                )
