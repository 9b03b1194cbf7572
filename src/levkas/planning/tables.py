"""The schema of a setup file: object, spectra, lamps, cameras and their places.

Millimetres, degrees, nanometres, seconds. x to the right and y downwards as the camera sees the
object, z from the object towards the camera, origin at the object's middle.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from levkas.campaign.schema.tables import Range, Table
from levkas.campaign.schema.values import Number, Size, SizeMm, Switch, Text
from levkas.core.problems import Problem, Refused

Positive = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
NotNegative = Annotated[Number, Field(ge=0)]


def _names(value: Any) -> Any:
    value = [value] if isinstance(value, str) else value
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise ValueError("must be a name or a list of names")
    return tuple(value)


NameList = Annotated[tuple[str, ...], BeforeValidator(_names)]


class Varnish(Table):
    """A clear coat over the paint; roughness is GGX's alpha."""

    roughness: Annotated[Number, Field(ge=0.005, le=1)]
    index: Annotated[Number, Field(gt=1, lt=3)] = 1.5


class Gilding(Table):
    """Gold leaf; roughness is GGX's alpha."""

    roughness: Annotated[Number, Field(ge=0.005, le=1)]


class StudioObjectKeys(Table):
    """What is to be captured."""

    title: Text = ""
    size_mm: SizeMm
    recess_mm: NotNegative = 0.0
    border_mm: NotNegative = 30.0
    bevel_mm: Positive = 4.0
    relief_slope: Annotated[Number, Field(ge=0, le=1)] = 0.15
    unevenness_deg: Annotated[Number, Field(ge=0, le=30)] = 5.0
    varnish: Varnish | None = None
    gold: Gilding | None = None
    darkest: Annotated[Number, Field(gt=0, le=1)] = 0.05


class SpectrumKeys(Table):
    """One spectrum: light, or the transmittance of a filter."""

    planck_k: Annotated[Number, Field(ge=500, le=50_000)] | None = None
    cie: Text | None = None
    csv: Text | None = None


class LampKeys(Table):
    """A kind of lamp."""

    spectrum: Text
    filters: NameList = ()
    power_w: Positive | None = None
    efficacy_lm_per_w: Positive = 20.0
    beam_deg: Annotated[Number, Field(gt=0, lt=90)] | None = None
    size_mm: SizeMm | None = None


class PlacedLamp(Table):
    """One lamp of a setup."""

    lamp: Text
    angle_deg: Annotated[Number, Field(ge=0, lt=88)]
    azimuth_deg: Number = 0.0
    distance_mm: Annotated[Number, Field(ge=10, le=50_000)]
    aim: Literal["middle", "far edge"] = "middle"
    filters: NameList | None = None
    polariser: Literal["p", "s"] | None = None


class Sheets(Table):
    """Sheet polarisers: what one passes of unpolarised light, and two crossed over two parallel."""

    transmittance: Annotated[Number, Field(gt=0, le=0.5)] = 0.38
    leak: Annotated[Number, Field(gt=0, lt=1)] = 1e-3


class SetupKeys(Table):
    """A lighting: lamps in their places, with what was measured of it."""

    title: Text = ""
    lamps: Annotated[tuple[PlacedLamp, ...], Field(min_length=1)]
    camera_polariser: Literal["crossed"] | None = None
    illuminance_lx: Positive | None = None


class StudioCameraKeys(Table):
    """A camera before the object's middle, its axis along the object's normal."""

    pixels: Size
    pitch_um: Annotated[Number, Field(ge=0.3, le=200)]
    focal_mm: Annotated[Number, Field(ge=2, le=5000)]
    f_number: Annotated[Number, Field(ge=0.5, le=128)]
    distance_mm: Annotated[Number, Field(ge=10, le=50_000)]
    sensitivity: Text | None = None
    wavelengths: Range | None = None
    fwhm_nm: Positive = 10.0
    peak_qe: Annotated[Number, Field(gt=0, le=1)] = 0.5
    exposure: Literal["one", "per band"] = "one"
    sensors: tuple[tuple[Text, ...], ...] = ()
    longest_s: Positive = 10.0
    lens_transmittance: Annotated[Number, Field(gt=0, le=1)] = 0.9
    full_well_e: Positive = 45_000.0
    read_e: NotNegative = 5.0
    dark_e_per_s: NotNegative = 32.0
    has_polariser: Switch = False


class Target(Table):
    """The exposure aimed at."""

    share_of_full: Annotated[Number, Field(gt=0, lt=1)] = 0.85
    white: Annotated[Number, Field(gt=0, le=1.2)] = 0.95


class Bench(Table):
    """The whole of a setup file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    title: Text = ""
    object: StudioObjectKeys
    spectra: dict[str, SpectrumKeys] = Field(min_length=1)
    lamps: dict[str, LampKeys] = Field(min_length=1)
    cameras: dict[str, StudioCameraKeys] = Field(default_factory=dict)
    setups: dict[str, SetupKeys] = Field(min_length=1)
    sheets: Sheets = Sheets()
    target: Target = Target()


EXPLAINED = "docs/planning.md explains every key."


class PlanRefused(Refused):
    """A setup that cannot be planned; every reason is listed."""


def value_problem(
    file: str, field: str, message: str, found: Any = None, expected: Any = None,
    fix: str = EXPLAINED, code: str = "E_VALUE",
) -> Problem:  # fmt: skip
    """Return a value's problem."""
    return Problem(code, message, file, field, _plain(found), expected, fix)


def _plain(value: Any) -> Any:
    """A list as text: problems are compared, which lists cannot be."""
    return str(value) if isinstance(value, list | tuple) else value
