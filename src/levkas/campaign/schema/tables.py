"""The tables of campaign.toml: which keys there are, and which values each of them takes."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    create_model,
)

from levkas.campaign.camera_kinds import KINDS, CameraKind, known_kind
from levkas.campaign.schema.values import (
    Address,
    Align,
    Date,
    Doi,
    Files,
    MosaicPattern,
    MuseumDate,
    Names,
    Number,
    Orcid,
    Outline,
    PathText,
    Rectangles,
    Reflectance,
    Region,
    Size,
    SizeMm,
    Switch,
    Text,
    Whole,
)
from levkas.registration.methods import METHODS, UNUSABLE

MOST_WAVELENGTHS = 100_000


PLAN, CALIBRATE, LIGHT, NATIVE = "plan", "calibrate", "light", "native"
REGISTER, FACT, REPORT, CAMERA, CATALOGUE = "register", "fact", "report", "camera", "catalogue"
"""What of a build reads a key first: the plan, which finds captures and their files; a stage; the page of a camera, then those of
objects, or these alone; `LIGHT`: a calibration by the spectrum of a white, and the pages of objects; `NATIVE`: whether a calibration
publishes its pixels; `FACT`: what is written beside pixels that stay."""


class Table(BaseModel):
    """A table of which every key is known; what reads its keys first is `read_by`, but where a row says otherwise."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    read_by: ClassVar[str] = PLAN

    @classmethod
    @cache
    def reader_of(cls, key: str) -> str:
        """Return what of a build reads a key first."""
        marks = [mark for mark in cls.model_fields[key].metadata if isinstance(mark, str)]
        return marks[-1] if marks else cls.read_by


class Range(Table):
    """Wavelengths at equal steps, both ends included, nm."""

    start: Annotated[Number, Field(gt=0)]
    stop: Annotated[Number, Field(gt=0)]
    step: Annotated[Number, Field(gt=0)]

    def values(self) -> tuple[float, ...]:
        """Return the wavelengths, nm; empty where the steps do not lead from start to stop.

        >>> Range(start=400, stop=420, step=10).values()
        (400.0, 410.0, 420.0)
        """
        return _steps(self.start, self.stop, self.step)


@lru_cache(maxsize=256)
def _steps(start: float, stop: float, step: float) -> tuple[float, ...]:
    count = (stop - start) / step
    if not -1e-6 < count < MOST_WAVELENGTHS or abs(count - round(count)) > 1e-6:
        return ()
    return tuple(round(start + i * step, 6) for i in range(round(count) + 1))


Wavelengths = Annotated[
    Annotated[Range, Tag("<table>")]
    | Annotated[tuple[Annotated[Number, Field(gt=0)], ...], Tag("<list>")],
    Discriminator(lambda value: "<table>" if isinstance(value, dict | Range) else "<list>"),
]


def _reference(value: Any) -> Any:
    if isinstance(value, str):
        camera, _, band = value.partition(":")
        return {"camera": camera, "band": band} if band else {"camera": camera}
    return value


def _white(value: Any) -> Any:
    return {"names": value} if isinstance(value, str | list) else value


def _camera_white(value: Any) -> Any:
    if isinstance(value, dict) and {"chart", "names"} <= value.keys():
        raise ValueError("must be white frames or a chart, not both: remove `chart` or `names`")
    return value


def _creator(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


class ReferenceKeys(Table):
    """The band that all others are registered to."""

    read_by: ClassVar[str] = REGISTER

    camera: Annotated[Text, PLAN]
    band: Text | None = None


class Description(Table):
    """The campaign as a whole."""

    title: Annotated[Text, REPORT] = ""
    creator: Annotated[Text, FACT] = ""
    date: Annotated[Date | None, FACT] = None
    licence: Annotated[Text, FACT] = ""
    reference: Annotated[ReferenceKeys, BeforeValidator(_reference)]
    setup: Text = ""
    output: Annotated[PathText, Field(min_length=1)] = "database"


class GridKeys(Table):
    """The published frame."""

    read_by: ClassVar[str] = REGISTER

    mirror: Switch = False
    rotate: Number = 0.0
    region: Region | None = None
    size: Size | None = None


class DatabaseKeys(Table):
    """What the database holds beside its layers on the grid: `native`, every layer in the pixels of its sensors."""

    read_by: ClassVar[str] = NATIVE

    native: Switch = False


def _usable(name: Any) -> Any:
    """Refuse the method of a package that cannot be loaded, or is not installed."""
    if isinstance(name, str) and name in UNUSABLE and name not in METHODS:
        raise ValueError(f"be another one: {name!r} cannot be used, {UNUSABLE[name]}")
    if isinstance(name, str) and name not in METHODS:
        *most, last = map(repr, METHODS)
        raise ValueError(
            f"be {', '.join(most)} or {last}, or that of a package which is installed beside Levkas"
        )
    return name


class MethodKey(Table):
    """The key that names the registration method."""

    read_by: ClassVar[str] = REGISTER

    method: Annotated[Literal[tuple(METHODS)] | None, BeforeValidator(_usable)] = None  # type: ignore[valid-type]


class PointsKeys(Table):
    """Control points."""

    read_by: ClassVar[str] = REGISTER

    points: Annotated[PathText, Field(min_length=1)] | None = None
    use: Literal["check", "seeds", "start"] | None = None
    accept: Literal["by hand"] | None = None


def _options() -> dict[str, Any]:
    """Return the options of all methods as fields of a table."""
    fields: dict[str, Any] = {}
    for method in METHODS.values():
        for name, field in method.options.model_fields.items():
            fields.setdefault(name, (field.annotation, None))
    return fields


OptionKeys: Any = create_model("OptionKeys", __base__=MethodKey, **_options())


class RegistrationKeys(PointsKeys, OptionKeys):  # type: ignore[misc]
    """Registration of cameras; errors in reference pixels."""

    def declared(self) -> dict[str, Any]:
        """Return the declared values, by key."""
        return {key: value for key, value in self if value is not None}


OPTIONS = tuple(name for name in OptionKeys.model_fields if name != "method")
"""Keys of [registration] that are options of a method."""


MOST_PX = 1e6

Place = Annotated[Number, Field(ge=-MOST_PX, le=MOST_PX)]
Corner = tuple[Place, Place]


class ChartWhite(Table):
    """A colour chart of known spectra in place of a white frame.

    `corners` are the centres of the corner patches, native px, clockwise from the first.
    """

    read_by: ClassVar[str] = CALIBRATE

    chart: Annotated[Text, Field(min_length=1)]
    reference: Annotated[PathText, Field(min_length=1)] | None = None
    corners: tuple[Corner, Corner, Corner, Corner] | None = None


CameraWhite = Annotated[
    Annotated[ChartWhite, Tag("<table>")] | Annotated[Names, Tag("<names>")],
    Discriminator(lambda value: "<table>" if isinstance(value, dict | ChartWhite) else "<names>"),
]


class SensorKeys(Table):
    """One sensor of a multi-sensor camera."""

    name: Text
    files: Files = ()
    pattern: MosaicPattern | None = None
    bands: Names = ()
    align: Align = "measure"


Share = Annotated[Number, Field(ge=0, le=0.1)]
"""Of a standard uncertainty that is a share: a larger one is meant in per cent."""


class UncertaintyKeys(Table):
    """Standard uncertainties of a camera that its frames do not show.

    `wavelength_nm` of the centre of a band; `linearity` of a value, relative; `stray_light` as a share of the white's light.
    """

    read_by: ClassVar[str] = CAMERA

    wavelength_nm: Annotated[Number, Field(ge=0, le=100)] | None = None
    linearity: Share | None = None
    stray_light: Share | None = None


class CameraKeys(Table):
    """One camera and how its files are named."""

    read_by: ClassVar[str] = CALIBRATE

    kind: Annotated[Text, AfterValidator(known_kind)]
    files: Annotated[Files, PLAN] = ()
    pattern: Annotated[MosaicPattern | None, PLAN] = None
    bands: Annotated[Names | None, PLAN] = None
    wavelengths: Annotated[Wavelengths | None, PLAN] = None
    sensitivity: PathText | None = None
    reference_band: Annotated[Text | None, REGISTER] = None
    bits: Annotated[Whole, Field(ge=1, le=32)] | None = None
    black: Number | None = None
    saturation: Annotated[Number, Field(gt=0)] | None = None
    exposures: Literal["one", "best", "merge"] = "one"
    manifest: Annotated[PathText | None, PLAN] = None
    positions: Annotated[PathText | None, REGISTER] = None
    sensors: Annotated[tuple[SensorKeys, ...], PLAN] = ()
    scan: Literal["push-broom", "mirror"] | None = None
    overrule: Names = ()
    denoise: Literal["hysime"] | None = None
    demosaic: Literal["malvar", "bilinear", "normalised"] | None = None
    dark: Annotated[Names | None, PLAN] = None
    white: Annotated[CameraWhite | None, BeforeValidator(_camera_white)] = None
    uncertainty: UncertaintyKeys = UncertaintyKeys()
    registration: RegistrationKeys = RegistrationKeys()

    @property
    def traits(self) -> CameraKind:
        """What follows of its kind."""
        return KINDS[self.kind]

    @property
    def has_frames(self) -> bool:
        """Whether what it captures are calibrated frames: neither lines of a scanner nor finished photographs."""
        return self.traits.is_calibrated and not self.traits.is_scanned

    @property
    def centres(self) -> tuple[float, ...] | None:
        """Declared wavelengths, nm."""
        return (
            self.wavelengths.values() if isinstance(self.wavelengths, Range) else self.wavelengths
        )

    @property
    def white_names(self) -> tuple[str, ...] | None:
        """Declared values of {target} that are whites; none where a chart takes their place."""
        return () if isinstance(self.white, ChartWhite) else self.white

    @property
    def white_chart(self) -> ChartWhite | None:
        """The chart that takes the place of a white frame."""
        return self.white if isinstance(self.white, ChartWhite) else None

    @property
    def has_tiles(self) -> bool:
        """Whether its frames show parts of an object."""
        return any(f"{{{f}}}" in text for text in self.patterns for f in ("tile", "row", "column"))

    @property
    def patterns(self) -> tuple[str, ...]:
        """Every pattern of files, the sensors' own included."""
        return (*self.files, *(text for sensor in self.sensors for text in sensor.files))


class White(Table):
    """The white board; `uncertainty` is the standard uncertainty (k = 1) of its reflectance, a share of the perfect diffuser's."""

    names: Names
    reflectance: Annotated[Reflectance | None, CALIBRATE] = None
    uncertainty: Annotated[Share | None, CAMERA] = None


class TargetKeys(Table):
    """Roles of the values of {target}."""

    dark: Names = ()
    white: Annotated[White, BeforeValidator(_white)] | None = None
    charts: Annotated[dict[str, Text], CALIBRATE] = {}
    edges: Annotated[dict[str, dict[str, Rectangles]], CAMERA] = {}
    traps: Annotated[dict[str, dict[str, Rectangles]], CALIBRATE] = {}
    objects: Names | None = None


class SetupCamera(Table):
    """A camera under another lighting."""

    files: Files = ()


class Setup(Table):
    """A lighting: another one with its cameras, or the default one, which has none of its own.

    `angle_deg` lies between the light and the normal of the object; `angle_uncertainty_deg` is by how much the white may have stood
    otherwise than the object, standard uncertainty.
    """

    title: Annotated[Text, CATALOGUE] = ""
    description: Annotated[Text, CATALOGUE] = ""
    spectrum: Annotated[PathText | None, LIGHT] = None
    angle_deg: Annotated[Annotated[Number, Field(ge=0, le=85)] | None, CAMERA] = None
    angle_uncertainty_deg: Annotated[Annotated[Number, Field(ge=0, le=30)] | None, CAMERA] = None
    cameras: dict[str, SetupCamera] = {}


class ObjectFacts(Table):
    """Museum facts of a painting, and its outline in the reference's frame, native px of the reference band."""

    read_by: ClassVar[str] = REPORT

    title: Annotated[Text, FACT] = ""
    creator: Text = ""
    date: MuseumDate | None = None
    medium: Text = ""
    size_mm: Annotated[SizeMm | None, FACT] = None
    owner: Text = ""
    rights: Annotated[Text, FACT] = ""
    inventory: Text = ""
    outline: Annotated[Outline | None, REGISTER] = None

    def museum_facts(self) -> dict[str, Any]:
        """Return what is published of the painting; its outline is of one camera's frame."""
        return self.model_dump(exclude={"outline"})


class Creator(Table):
    """A person who made the database, or an organisation."""

    read_by: ClassVar[str] = CATALOGUE

    name: Annotated[Text, Field(min_length=1)]
    orcid: Orcid | None = None
    affiliation: Text = ""
    organisation: Switch | None = None


class PublicationKeys(Table):
    """Citation facts of the published database."""

    read_by: ClassVar[str] = CATALOGUE

    creators: tuple[Annotated[Creator, BeforeValidator(_creator)], ...] = ()
    description: Text = ""
    keywords: Names = ()
    publisher: Text = ""
    date: Date | None = None
    version: Text = ""
    doi: Doi | None = None
    url: Address | None = None
    contact: Text = ""
    related: tuple[Address, ...] = ()


class Document(Table):
    """The whole of campaign.toml."""

    campaign: Description
    grid: GridKeys | None = None
    database: DatabaseKeys = DatabaseKeys()
    cameras: dict[str, CameraKeys] = Field(min_length=1)
    targets: TargetKeys = TargetKeys()
    setups: dict[str, Setup] = {}
    objects: dict[str, ObjectFacts] = {}
    registration: RegistrationKeys = RegistrationKeys()
    publication: PublicationKeys = PublicationKeys()


Pair = tuple[Place, Place, Place, Place]
Move = tuple[Place, Place, Place, Place, Place, Place, Place, Place]


class FrameKeys(Table):
    """Corrections of one camera, under one lighting, for one object.

    Pairs are (reference x, reference y, target x, target y); a move is a pair and the pair that
    takes its place.
    """

    deleted: tuple[Pair, ...] = ()
    restored: tuple[Pair, ...] = ()
    pinned: tuple[Pair, ...] = ()
    added: tuple[Pair, ...] = ()
    moved: tuple[Move, ...] = ()
    checks: tuple[Pair, ...] = ()
    reject: Annotated[Number, Field(gt=0)] | None = None
    stop: Annotated[Number, Field(gt=0)] | None = None
    accept: Literal["by hand", ""] = ""


class ObjectKeys(Table):
    """Corrections of one object: its outline, and by frame name: CAMERA, CAMERA@SETUP, CAMERA:BAND, CAMERA#TILE, CAMERA#TILE#NEIGHBOUR."""

    outline: Outline | None = None
    cameras: dict[str, FrameKeys] = Field(default={})


class ConfirmKeys(Table):
    """A person's word that a doubtful layer is right, as long as it has this map; `camera` is OBJECT/CAMERA[@SETUP]."""

    camera: Text
    name: Annotated[Text, Field(min_length=1)]
    date: Date
    words: Annotated[Text, Field(min_length=1)]
    map: Text


class EditsDocument(Table):
    """edits.toml as a whole."""

    version: Literal[1]
    objects: dict[str, ObjectKeys] = Field(default={})
    confirm: tuple[ConfirmKeys, ...] = ()
