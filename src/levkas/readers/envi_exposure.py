"""The exposure that an ENVI header states: in which field, in which unit, for all bands or band by band."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from levkas.readers.envi_header import Fields, number_of, text_of
from levkas.readers.facts import unreadable

MILLISECONDS = ("tint",)
"""Fields of one unit, whoever writes them: Specim's."""
BARE = (
    "integration time",
    "integration times",
    "exposure",
    "exposures",
    "exposure time",
    "exposure times",
    "shutter",
)
"""Fields of many vendors, in ms by some and in µs by others: understood where a unit stands with them."""
SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microsecond": 1e-6,
    "ns": 1e-9, "nanosecond": 1e-9,
}  # fmt: skip
SAME = 0.01
"""Relative: fields that differ by less say the same."""
_KEY = re.compile(r"(?P<name>[a-z ]+?) ?(?:[(\[] ?(?P<unit>[a-zµμ]+) ?[)\]])?")
_VALUE = re.compile(r"(?P<number>[^\sa-zµμ]\S*?) ?(?P<unit>[a-zµμ]+)?")


def exposure_facts(path: Path, fields: Fields, bands: int) -> dict[str, Any]:
    """Return `exposure_s`, `band_times_s` and `exposure_unclear`, as `Facts` has them.

    Raises
    ------
    UnreadableCapture
        E_BAND_COUNT where a list of exposures has another length than the bands.

    Examples
    --------
    >>> exposure_facts(Path("a.hdr"), {"exposure time (ms)": "20"}, 3)
    {'exposure_s': 0.02}
    >>> exposure_facts(Path("a.hdr"), {"integration time": "20"}, 3)
    {'exposure_unclear': 'integration time = 20'}
    """
    clear: dict[str, tuple[float, ...]] = {}
    unclear = []
    for key in fields:
        found = _KEY.fullmatch(key[:100].replace("_", " "))
        if found is None or found["name"] not in (*MILLISECONDS, *BARE):
            continue
        numbers, units = _numbers(fields, key)
        if not numbers:
            continue
        units |= {found["unit"]} if found["unit"] else set()
        units |= {text_of(fields, f"{key} {word}").lower() for word in ("unit", "units")} - {""}
        if not units and found["name"] in MILLISECONDS:
            units = {"ms"}
        scale = {SECONDS.get(unit) or SECONDS.get(unit.rstrip("s")) for unit in units}
        if len(scale) != 1 or None in scale:
            unclear.append(f"{key} = {_shown(fields[key])}")
            continue
        if len(numbers) not in (1, bands):
            raise unreadable(
                path,
                f"the list of {key} does not fit the bands",
                code="E_BAND_COUNT",
                field=key,
                found=f"{len(numbers)} numbers",
                expected=f"{bands}, or one",
                fix="Write one number a band, or one for all.",
            )
        factor = float(next(iter(scale)) or 0.0)
        clear[key] = tuple(float(f"{number * factor:.12g}") for number in numbers)
    if clear and not _alike(list(clear.values())):
        unclear, clear = [f"{key} = {_shown(fields[key])}" for key in clear], {}
    if not clear:
        return {"exposure_unclear": "; ".join(unclear)} if unclear else {}
    times = next(iter(clear.values()))
    if len(set(times)) == 1:
        return {"exposure_s": times[0]}
    return {"band_times_s": times}


def _numbers(fields: Fields, key: str) -> tuple[list[float], set[str]]:
    """Return the numbers of a field, none where it is not numbers above 0, and the units behind them."""
    raw = fields[key]
    numbers, units = [], set()
    for text in raw if isinstance(raw, list) else [raw]:
        found = _VALUE.fullmatch(text.strip().lower()[:100])
        value = number_of(found["number"]) if found else None
        if found is None or value is None or value <= 0:
            return [], set()
        numbers.append(value)
        units |= {found["unit"]} if found["unit"] else set()
    return numbers, units


def _alike(stated: list[tuple[float, ...]]) -> bool:
    """Tell whether fields say the same times; one number stands for all bands."""
    longest = max(len(times) for times in stated)
    every = [times * longest if len(times) == 1 else times for times in stated]
    return all(max(same) <= min(same) * (1 + SAME) for same in zip(*every, strict=True))


def _shown(value: str | list[str]) -> str:
    return value[:40] if isinstance(value, str) else "{" + ", ".join(value)[:40] + "}"
