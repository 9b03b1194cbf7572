"""The facts in which the files of one camera must agree, and how two of each are compared.

`FACTS` is the one table: docs/reference/facts.md, the key `overrule` of campaign.toml and the comparison of a
build are made of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from levkas.readers.black_levels import BlackLevels
from levkas.readers.facts import Facts

Severity = Literal["same", "noted", "refused"]
LIT = ("object", "white", "chart")
"""Roles whose frames saw light: what stands between light and sensor must agree in them alone."""
ALL = (*LIT, "dark")
NEAREST_NM = 0.5
"""Wavelengths that differ by less are one: headers round to whole nm. A lamp's counts change by 0.3 % over it."""
ISO_RATIO, STOP_RATIO, FOCAL_RATIO = 1.005, 1.03, 1.02
"""Larger over smaller up to which two are one. A third of a stop, the least step, is 1.26 in ISO and 1.12 in f; f/5.6 is
written 5.6 or 5.657. A focal length is rounded to whole mm, 1 in 50."""
BLACK_NOTED, BLACK_REFUSED = 1e-4, 2e-3
"""Of the full scale: cameras measure their black level anew for each frame, within some 1e-4. Half of 2e-3 is an error
of 5 % at a reflectance of 0.02."""


@dataclass(frozen=True)
class ComparedFact:
    """One fact of the files of a camera.

    `name` is as `overrule` accepts it, `title` as messages name it; `fields` are of `Facts`, none where codes are measured;
    files of `roles` must agree, by `compare` (a warning names both where they are ``"noted"``); where `per_band`, bands of
    one file each may differ; `fix` is what to do.
    """

    name: str
    title: str
    fields: tuple[str, ...]
    roles: tuple[str, ...]
    compare: Callable[[Any, Any], Severity]
    per_band: bool = False
    fix: str = "Use frames of one mode of the camera, or capture again."

    def advice(self, camera: str) -> str:
        """Return what to do about a difference, and how a camera accepts it."""
        return (
            f'{self.fix} To take the codes as they are, write `overrule = ["{self.name}"]` '
            f"under [cameras.{camera}]."
        )


def read_fact(fact: ComparedFact, facts: Facts) -> Any:
    """Return the value of a fact that a file states; None where it states none."""
    if fact.name == "white_balance" and len(facts.shape) < 3:
        return None  # of grey frames and mosaics it is a setting that changed no code
    if fact.name == "bits" and np.dtype(facts.dtype).kind != "u":
        return None
    if fact.name == "black":
        if facts.black is None:
            return None
        return facts.black, full_scale(facts), facts.blacks or BlackLevels(((facts.black,),))
    return getattr(facts, fact.fields[0])


def full_scale(facts: Facts) -> float:
    """Return the largest code that a file can hold: its saturation, else that of its bits; 1 of floats."""
    if facts.saturation:
        return facts.saturation
    return float(2**facts.bits - 1) if facts.bits and np.dtype(facts.dtype).kind == "u" else 1.0


def describe_value(fact: ComparedFact, value: Any) -> str:
    """Return a value as messages give it.

    >>> describe_value(FACTS_BY_NAME["wavelengths"], (400.0, 450.0, 500.0, 550.0))
    '400 to 550 nm (4)'
    >>> describe_value(FACTS_BY_NAME["gain"], (("gain", "2"),))
    'gain = 2'
    """
    if fact.name == "wavelengths" and len(value) < 3:
        return ", ".join(f"{v:g}" for v in value) + " nm"
    match fact.name:
        case "wavelengths":
            return f"{value[0]:g} to {value[-1]:g} nm ({len(value)})"
        case "black":
            return f"{value[0]:g}" + (", not even" if value[2].varies else "")
        case "bands":
            return ", ".join(value[:4]) + (" …" if len(value) > 4 else "")
        case "gain" | "binning" | "region":
            return "; ".join(f"{key} = {text}" for key, text in value)
        case "f_number":
            return f"f/{value:g}"
    return f"{value:g}" if isinstance(value, float) else str(value)


# --- how two values are compared -----------------------------------------------------------------


def compare_equal(a: Any, b: Any) -> Severity:
    """Compare two values that are the same or not."""
    return "same" if a == b else "refused"


def compare_texts(a: str, b: str) -> Severity:
    """Compare two names, upper and lower case alike."""
    return "same" if a.casefold() == b.casefold() else "refused"


def compare_makers(a: str, b: str) -> Severity:
    """Compare two makers by their first words: programs write "NIKON" for "NIKON CORPORATION".

    >>> compare_makers("NIKON CORPORATION", "Nikon"), compare_makers("Phase One", "Canon")
    ('same', 'refused')
    """
    return compare_texts(a.split()[0], b.split()[0])


def compare_ratio(most: float) -> Callable[[float, float], Severity]:
    """Return the comparison of two positive numbers by the larger over the smaller."""

    def compare(a: float, b: float) -> Severity:
        return "same" if max(a, b) <= most * min(a, b) else "refused"

    return compare


def compare_wavelengths(a: Sequence[float], b: Sequence[float]) -> Severity:
    """Compare two lists, nm, band by band; lists of other lengths are counted elsewhere.

    >>> compare_wavelengths((400.4, 450.0), (400.0, 450.0)), compare_wavelengths((450.0,), (500.0,))
    ('same', 'refused')
    """
    if len(a) != len(b):
        return "same"
    return "same" if np.allclose(a, b, rtol=0, atol=NEAREST_NM) else "refused"


def compare_names(a: Sequence[str], b: Sequence[str]) -> Severity:
    """Compare the names of bands: another order is refused, other names are noted.

    ENVI writes the name of its file into those of bands, so other names alone contradict nothing. Case does not count.

    >>> compare_names(["blue", "red"], ["Red", "Blue"]), compare_names(["blue", "red"], ["Blue", "Red"])
    ('refused', 'same')
    """
    one, other = ([name.strip().casefold() for name in names] for names in (a, b))
    if len(one) != len(other) or one == other:
        return "same"
    return "refused" if set(one) & set(other) else "noted"


def compare_types(a: str, b: str) -> Severity:
    """Compare two sample types: integers of 16 bits are one, signed or not; floats may hold counts too.

    >>> compare_types("uint16", "int16"), compare_types("uint16", "float32"), compare_types("uint8", "uint16")
    ('same', 'noted', 'refused')
    """
    one, other = np.dtype(a), np.dtype(b)
    kinds = {"f" if dtype.kind == "f" else "i" for dtype in (one, other)}
    if kinds == {"f"}:
        return "same"
    if len(kinds) == 2:
        return "noted"
    return "same" if one.itemsize == other.itemsize else "refused"


def compare_black(
    a: tuple[float, float, BlackLevels], b: tuple[float, float, BlackLevels]
) -> Severity:
    """Compare two black levels, counts, by their means and sensel by sensel, each with the full scale of its file."""
    apart, full = max(abs(a[0] - b[0]), a[2].distance(b[2])), max(a[1], b[1])
    if apart <= max(BLACK_NOTED * full, 0.5):
        return "same"
    return "noted" if apart <= BLACK_REFUSED * full else "refused"


def compare_settings(a: Sequence[tuple[str, str]], b: Sequence[tuple[str, str]]) -> Severity:
    """Compare settings field by field, those that both headers have.

    >>> compare_settings((("gain", "2"),), (("gain", "2"), ("gain mode", "high")))
    'same'
    """
    one, other = dict(a), dict(b)
    return "same" if all(one[key] == other[key] for key in one.keys() & other.keys()) else "refused"


SAVED = "Save all frames of the camera in one format from its own files."
ONE_SCAN = "Use the dark and white of this scan, or correct the header that is wrong."
ALIKE = "Capture again with the same setting: another one changes the codes by an unknown factor."
ONE_CAMERA = "Use frames of the same camera, or declare two cameras."


FACTS = tuple(
    ComparedFact(name, title, fields, roles, compare, per_band, *fix)
    for name, title, fields, roles, compare, per_band, *fix in (
        ("wavelengths", "wavelengths", ("wavelengths",), ALL, compare_wavelengths, True, ONE_SCAN),
        ("bands", "names of bands", ("band_names",), ALL, compare_names, True, ONE_SCAN),
        ("sample_type", "sample type", ("dtype",), ALL, compare_types, False, SAVED),
        ("code_spacing", "alignment of codes", (), ALL, compare_equal, False, SAVED),
        ("bits", "bits of a code", ("bits",), ALL, compare_equal, False, SAVED),
        ("saturation", "full scale", ("saturation",), ALL, compare_ratio(1.001), False),
        ("black", "black level", ("black", "blacks"), ALL, compare_black, False),
        ("pattern", "mosaic pattern", ("pattern",), ALL, compare_equal, False),
        ("iso", "ISO", ("iso",), ALL, compare_ratio(ISO_RATIO), True, ALIKE),
        ("gain", "gain", ("gain",), ALL, compare_settings, True, ALIKE),
        ("f_number", "f-number", ("f_number",), LIT, compare_ratio(STOP_RATIO), True, ALIKE),
        ("lens", "lens", ("lens",), LIT, compare_texts, True, ALIKE),
        ("focal_length", "focal length, mm", ("focal_mm",), LIT, compare_ratio(FOCAL_RATIO), True, ALIKE),
        ("white_balance", "white balance", ("white_balance",), LIT, compare_equal, True, ALIKE),
        ("make", "maker of the camera", ("make",), ALL, compare_makers, True, ONE_CAMERA),
        ("model", "camera model", ("model",), ALL, compare_texts, True, ONE_CAMERA),
        ("serial", "serial number", ("serial",), ALL, compare_texts, True, ONE_CAMERA),
        ("binning", "binning", ("binning",), ALL, compare_settings, False),
        ("region", "region of the sensor", ("region",), ALL, compare_settings, False),
    )
)  # fmt: skip
"""Bits, full scale, black level and pattern are one for all bands of a sensor."""
FACTS_BY_NAME = {fact.name: fact for fact in FACTS}
SCALE = "reflectance_scale"
OVERRULED = (*FACTS_BY_NAME, SCALE)
"""Names that `overrule` takes: of what is compared, and of the scale of reflectance, which raw scans may state too."""
