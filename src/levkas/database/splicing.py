"""Two spectral layers of one object spliced to one: a visible and near-infrared spectrograph, and a short-wave one.

Both lie on the grid, registered, each with its own optics, white and noise. The spectrum goes over from one to the other at a wavelength
that both see; where both see, the second over the first shows how far they agree: a step there is an error of a white, of stray light or of a
wavelength scale, and a spread beyond the noise one of registration or resolution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from math import isnan, nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from levkas.calibration.error_sources import Extent
from levkas.core.cube import Band, Cube, CubeRows, band_labels
from levkas.core.problems import Problem, closest_match
from levkas.database.catalogue import MEASURED, SPLICED, DatabaseRefused
from levkas.database.credits import Credits
from levkas.database.derived import DerivedStep, check_new_layer, write_derived
from levkas.database.layers import Layer
from levkas.database.layout import LayerId
from levkas.database.manifest import write_manifest
from levkas.database.reader import Database
from levkas.database.region_uncertainty import LayerBudget, mean_correlation, read_budget

if TYPE_CHECKING:
    from levkas.database.layer_array import LayerArray

SAMPLES, LEAST_SAMPLES = 100_000, 100
"""Pixels among which layers are compared, and how many of them must be sound."""
LEAST_VALUE = 0.02
"""Reflectance below which a ratio says little."""
STEP, LARGEST_STEP = 0.02, 0.10
"""Relative: a larger step is doubtful; of a still larger one nobody knows which side is right."""
SPREAD, LEAST_SPREAD = 3.0, 0.02
"""Spread of the ratio over what sigma explains that is doubtful, and relative spread that always passes."""
ROWS = 64


@dataclass(frozen=True)
class SpectralOverlap:
    """How two layers agree where both see.

    Parameters
    ----------
    range_nm : (float, float) or None
        Wavelengths that both see; None for none.
    wavelengths_nm, gains : tuple of float
        Centres of the first layer's bands there, and the median of second over first at each, pixel by pixel.
    gain : float
        Their median: 1.03 where the second is brighter by 3 %; NaN where nothing could be compared.
    spread, noise : float
        Relative standard deviation of the ratio among pixels (robust), and what sigma explains of it; NaN where it is not known.
    samples : int
        Pixels that were compared.
    at_nm : float
        From where on the second layer's bands are taken.
    decision : str
        ``"accept"`` or ``"warn"``.
    reasons : tuple of str
    """

    range_nm: tuple[float, float] | None
    wavelengths_nm: tuple[float, ...]
    gains: tuple[float, ...]
    gain: float
    spread: float
    noise: float
    samples: int
    at_nm: float
    decision: str = "accept"
    reasons: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the record, JSON-ready; what is not known is None."""
        return {
            key: None if isinstance(value, float) and isnan(value) else value
            for key, value in asdict(self).items()
        }


@dataclass(frozen=True, kw_only=True)
class SplicedStep(DerivedStep):
    """One object whose layer was written, and what its sources showed where both see."""

    overlap: SpectralOverlap


def splice(
    database: str | Path,
    first: str,
    second: str,
    layer: str,
    *,
    at: float | None = None,
    level: bool = False,
    objects: Sequence[str] = (),
) -> Iterator[SplicedStep]:
    """Write a layer of the bands of two others for every object that has both, and judge how they agree where both see.

    Parameters
    ----------
    database : path
    first, second : str
        Measured layers of reflectance whose bands have wavelengths, ``CAMERA`` or ``CAMERA@SETUP``, in any order.
    layer : str
        Name of the new layer; a spliced one of this name is replaced.
    at : float, optional, nm
        From where on the bands of the layer of longer waves are taken; default: where the less noisy of the two changes, noise per nanometre,
        so that finer bands count for more; the middle of the overlap where sigma is not known.
    level : bool
        Whether the layer of longer waves is divided by the gain that the overlap shows, so that no step is left. It is recorded; values are as
        uncertain as before.
    objects : sequence of str
        Only these; default all.

    Raises
    ------
    DatabaseRefused
        Where a layer is missing, is no reflectance of known wavelengths or was made from others; where the name is that of a camera; where the
        two differ by more than 10 % and are not levelled; where `at` lies outside both.
    """
    root = Path(database)
    opened = Database(root)
    names = _objects_with(opened, (first, second))
    check_new_layer(opened, names, layer, objects, kind=SPLICED, field="NAME")
    chosen = [name for name in names if not objects or name in objects]
    for done, name in enumerate(chosen, 1):
        pair = _ordered(opened, name, (first, second))
        overlap = judge_overlap(pair[0][1], pair[1][1], at=at)
        _require_agreement(root, name, pair, overlap, level=level)
        files = _write(opened, layer, pair, overlap, level=level)
        yield SplicedStep(
            f"{name}/{layer} {_said(overlap, pair, level=level)}",
            done,
            len(chosen),
            files,
            overlap=overlap,
        )
    write_manifest(root)


Pair = tuple[tuple[LayerId, "LayerArray"], tuple[LayerId, "LayerArray"]]


# --- which layers -----------------------------------------------------------------------------


def _objects_with(database: Database, sources: Sequence[str]) -> list[str]:
    having = {
        source: [
            e.object for e in database.catalogue if e.layer.name == source and e.kind == MEASURED
        ]
        for source in sources
    }
    there = sorted({e.layer.name for e in database.catalogue if e.kind == MEASURED})
    for source in sources:
        if not having[source]:
            raise DatabaseRefused(
                Problem(
                    "E_MISSING",
                    "no object has this measured layer",
                    str(database.path),
                    "FIRST, SECOND",
                    source,
                    ", ".join(there),
                    closest_match(source, there),
                )
            )
    names = [name for name in having[sources[0]] if name in having[sources[1]]]
    if sources[0] == sources[1] or not names:
        found = f"{sources[0]} twice" if sources[0] == sources[1] else "no object has both layers"
        raise DatabaseRefused(
            Problem(
                "E_VALUE",
                "two layers of one object are spliced",
                str(database.path),
                "FIRST, SECOND",
                found,
                "two layers that an object has",
            )
        )
    return names


def _ordered(database: Database, name: str, sources: Sequence[str]) -> Pair:
    """Return two layers of an object, that of shorter waves first; refuse what has no wavelengths or is no reflectance."""
    found = []
    for key in (LayerId.parse(name, source) for source in sources):
        array = database[name][key.camera, key.setup]
        unknown = np.count_nonzero(np.isnan(_waves(array)))
        if array.attrs.get("quantity") != "reflectance" or unknown or len(_usable(array)) < 2:
            raise DatabaseRefused(
                Problem(
                    "E_QUANTITY",
                    f"{name}/{key.name} cannot be spliced",
                    str(database.path / f"{key.path}.tif"),
                    found=f"{array.attrs.get('quantity')}, {len(_usable(array))} bands that are not bad, "
                    f"{unknown} without a wavelength",
                    expected="reflectance in two or more bands of known wavelength",
                    fix="Declare a white, and `wavelengths` of the camera.",
                )
            )
        found.append((key, array))
    found.sort(key=lambda one: float(_waves(one[1]).mean()))
    return found[0], found[1]


def _waves(layer: LayerArray) -> np.ndarray:
    return np.asarray(layer.wavelength.values, float)


def _usable(layer: LayerArray) -> np.ndarray:
    """Return the places of the bands that are not bad, by rising wavelength."""
    bad = layer.attrs.get("bad_bands") or ()
    order = np.argsort(_waves(layer), kind="stable").tolist()
    return np.array([i for i in order if str(layer.band.values[i]) not in bad], int)


# --- the overlap ------------------------------------------------------------------------------


def judge_overlap(
    short: LayerArray, long: LayerArray, *, at: float | None = None
) -> SpectralOverlap:
    """Compare two layers of one grid where both see, in sound pixels of a lattice, and choose where one takes over.

    Parameters
    ----------
    short, long : LayerArray, (height, width, bands)
        Of shorter and of longer waves.
    at : float, optional, nm

    Raises
    ------
    DatabaseRefused
        Where `at` lies outside both layers, or leaves one without a band.
    """
    ours, theirs = (_waves(layer)[_usable(layer)] for layer in (short, long))
    low, high = max(ours.min(), theirs.min()), min(ours.max(), theirs.max())
    between = np.flatnonzero((ours >= low) & (ours <= high))
    if not len(between):
        middle = _checked(at, (ours.max() + theirs.min()) / 2, ours, theirs)
        why = f"no wavelength is seen by both: {ours.max():g} nm is the last of one, {theirs.min():g} nm the first of the other"
        return SpectralOverlap(None, (), (), nan, nan, nan, 0, middle, "warn", (why,))
    step = max(1, int(sqrt(short.shape[0] * short.shape[1] / SAMPLES)))
    mine, other = (_sample(layer, step, ours[between]) for layer in (short, long))
    bright = ((s.values > LEAST_VALUE).all(1) for s in (mine, other))
    good = np.logical_and.reduce([mine.sound, other.sound, *bright])
    count = int(np.count_nonzero(good))
    chosen = None
    if count and mine.noise is not None and other.noise is not None:
        # Of two layers of one noise the finer tells more of a nanometre.
        mine_noise, other_noise = (
            (noise[good] / sample.values[good]).mean(0) * np.sqrt(_spacing(waves))
            for noise, sample, waves in ((mine.noise, mine, ours), (other.noise, other, theirs))
        )
        chosen = _quietest(ours[between], mine_noise, other_noise, least=int(ours.min() >= low))
    where = _checked(at, (low + high) / 2 if chosen is None else chosen, ours, theirs)
    if count < LEAST_SAMPLES:
        why = f"only {count} sound pixels are seen by both from {low:g} to {high:g} nm: nothing shows that they agree"
        return SpectralOverlap(
            (low, high), tuple(ours[between]), (), nan, nan, nan, count, where, "warn", (why,)
        )
    ratios = other.values[good] / mine.values[good]
    gains = np.median(ratios, 0)
    relative = ratios / gains
    spread = float(1.4826 * np.median(np.abs(relative - 1)))
    explained = nan
    if mine.sigma is not None and other.sigma is not None:
        shares = mine.sigma[good] / mine.values[good], other.sigma[good] / other.values[good]
        explained = round(float(np.median(np.hypot(*shares))), 5)
    overlap = SpectralOverlap(
        (float(low), float(high)),
        tuple(ours[between].tolist()),
        tuple(gains.round(5).tolist()),
        gain=round(float(np.median(gains)), 5),
        spread=round(spread, 5),
        noise=explained,
        samples=count,
        at_nm=float(where),
    )
    return _judged(overlap)


def _judged(overlap: SpectralOverlap) -> SpectralOverlap:
    reasons = []
    off = overlap.gain - 1
    if abs(off) > STEP:
        reasons.append(
            f"the layer of longer waves is {abs(off):.1%} {'brighter' if off > 0 else 'darker'} where both see"
        )
    tilt = max(overlap.gains) - min(overlap.gains)
    if tilt > 2 * STEP:
        reasons.append(
            f"their ratio changes by {tilt:.1%} over the overlap: a wavelength scale, stray light or the end of a sensor"
        )
    if overlap.spread > max(
        LEAST_SPREAD, SPREAD * (0.0 if isnan(overlap.noise) else overlap.noise)
    ):
        reasons.append(
            f"pixels differ by {overlap.spread:.1%} where {'noise is not known' if isnan(overlap.noise) else f'noise explains {overlap.noise:.1%}'}: "
            "registration, or what the one resolves and the other does not"
        )
    return replace(overlap, decision="warn" if reasons else "accept", reasons=tuple(reasons))


@dataclass(frozen=True)
class _Sample:
    """Pixels of a layer at wavelengths between its bands, (n, wavelengths): values, sigma of what was interpolated, noise of a band there.

    `sound`, (n,), says which count.
    """

    values: np.ndarray
    sigma: np.ndarray | None
    noise: np.ndarray | None
    sound: np.ndarray


def _sample(layer: LayerArray, step: int, wanted: np.ndarray) -> _Sample:
    """Return every `step`-th pixel each way, interpolated linearly between the usable bands around each wanted wavelength."""
    waves, places = _waves(layer), _usable(layer)
    after = np.clip(np.searchsorted(waves[places], wanted), 1, len(places) - 1)
    left, right = places[after - 1], places[after]
    share = (wanted - waves[left]) / (waves[right] - waves[left])
    used = np.unique([left, right])
    left, right = np.searchsorted(used, left), np.searchsorted(used, right)
    flat = []
    for array in (layer, layer.flags, layer.sigma):
        part = (
            None
            if array is None
            else array.isel(y=slice(None, None, step), x=slice(None, None, step), band=used).values
        )
        flat.append(None if part is None else part.reshape(-1, len(used)))
    values, flags, sigma = flat
    assert values is not None and flags is not None
    sound = np.isfinite(values).all(1) & (flags == 0).all(1)
    mixed = values[:, left] * (1 - share) + values[:, right] * share
    if sigma is None:
        return _Sample(mixed, None, None, sound)
    ends = sigma[:, left] * (1 - share), sigma[:, right] * share
    return _Sample(mixed, np.hypot(*ends), ends[0] + ends[1], sound)


def _spacing(waves: np.ndarray) -> float:
    return float(np.median(np.diff(np.sort(waves))))


def _quietest(waves: np.ndarray, mine: np.ndarray, other: np.ndarray, least: int = 0) -> float:
    """Return where to change from one layer to the other so that their relative noises add up to the least; at least so many bands there stay the first's.

    >>> _quietest(np.array([950.0, 960, 970]), np.array([0.1, 0.2, 0.9]), np.array([0.5, 0.3, 0.1]))
    965.0
    """
    order = np.argsort(waves)
    before = np.concatenate([[0.0], np.cumsum(mine[order])])
    after = np.concatenate([np.cumsum(other[order][::-1])[::-1], [0.0]])
    place = least + int(np.argmin((before + after)[least:]))
    return float(waves[order][max(place - 1, 0) : place + 1].mean())


def _checked(at: float | None, found: float, ours: np.ndarray, theirs: np.ndarray) -> float:
    where = float(found if at is None else at)
    if (ours < where).any() and (theirs >= where).any():
        return where
    raise DatabaseRefused(
        Problem(
            "E_VALUE",
            "both layers must have bands in the spliced one",
            field="--at",
            found=f"{where:g} nm",
            expected=f"more than {ours.min():g} nm, and at most {theirs.max():g} nm",
        )
    )


def _require_agreement(
    root: Path, name: str, pair: Pair, overlap: SpectralOverlap, *, level: bool
) -> None:
    if level or isnan(overlap.gain) or abs(overlap.gain - 1) <= LARGEST_STEP:
        return
    raise DatabaseRefused(
        Problem(
            "E_DISAGREE",
            f"{name}: {pair[0][0].name} and {pair[1][0].name} do not agree where both see",
            str(root),
            found=f"{overlap.gain - 1:+.1%} from {pair[0][0].name} to {pair[1][0].name}, in {overlap.samples} pixels",
            expected=f"at most {LARGEST_STEP:.0%}",
            fix="Compare their whites and exposures first. --level divides the layer of longer waves by this gain: the step is hidden then, not explained.",
        )
    )


def _said(overlap: SpectralOverlap, pair: Pair, *, level: bool) -> str:
    names = f"{pair[0][0].name} to {overlap.at_nm:g} nm, then {pair[1][0].name}"
    if isnan(overlap.gain):
        return f"{names}: doubtful, {overlap.reasons[0]}"
    levelled = ", levelled" if level else ""
    found = f"{names}: step {overlap.gain - 1:+.2%}{levelled}, spread {overlap.spread:.2%}"
    return f"{found}: doubtful, {'; '.join(overlap.reasons)}" if overlap.reasons else found


# --- the layer --------------------------------------------------------------------------------


def _write(
    database: Database, layer: str, pair: Pair, overlap: SpectralOverlap, *, level: bool
) -> tuple[Path, ...]:
    (short_id, short), (long_id, long) = pair
    gain = overlap.gain if level and not isnan(overlap.gain) else 1.0
    orders = [np.argsort(_waves(layer), kind="stable") for layer in (short, long)]
    picked = [
        orders[0][_waves(short)[orders[0]] < overlap.at_nm],
        orders[1][_waves(long)[orders[1]] >= overlap.at_nm],
    ]
    bands = _bands((short, long), picked)
    keys, scale = (short_id, long_id), short.attrs.get("px_per_mm")
    verdicts = {e.layer: e.verdict for e in database.catalogue}
    worst = (
        "warn" if "warn" in (overlap.decision, *(verdicts.get(key) for key in keys)) else "accept"
    )
    facts = {
        "from": [key.name for key in keys],
        "at_nm": overlap.at_nm,
        "levelled_by": gain if level else None,
        "overlap": overlap.to_dict(),
    }
    described = Layer(
        short_id.object,
        layer,
        px_per_mm=nan if scale is None else float(scale),
        credits=Credits(
            title=f"{short_id.object}, {short_id.name} and {long_id.name} spliced",
            description=f"Bands of {short_id.name} to {overlap.at_nm:g} nm, of {long_id.name} from there on"
            + (f", divided by {gain:g}." if level else "."),
        ),
        kind=SPLICED,
        made_of=facts,
    )
    rows = CubeRows(
        _blocks((short, long), picked, bands, gain),
        (short.shape[0], short.shape[1], len(bands)),
        bands,
        "reflectance",
        has_sigma=short.sigma is not None or long.sigma is not None,
    )
    budgets = [read_budget(database.path, key) for key in keys]
    record = {
        "uncertainty": _rows_of_budgets(budgets, pair, picked, bands),
        "noise_correlation": mean_correlation([b.correlation for b in budgets]).round(4).tolist(),
    }
    return write_derived(database.path, described, rows, keys, record, verdict=worst)


def _bands(layers: Sequence[LayerArray], picked: Sequence[np.ndarray]) -> tuple[Band, ...]:
    """Return the bands of the spliced layer, by rising wavelength within each source; labels that two share become their wavelengths."""
    found = []
    for layer, places in zip(layers, picked, strict=True):
        bad = layer.attrs.get("bad_bands") or ()
        fwhm = layer.fwhm.values if "fwhm" in layer.coords else np.full(layer.shape[2], nan)
        found += [
            Band(
                str(layer.band.values[i]),
                float(_waves(layer)[i]),
                float(fwhm[i]),
                str(layer.band.values[i]) in bad,
            )
            for i in places
        ]
    labels = [band.label for band in found]
    if len(set(labels)) < len(labels):
        labels = band_labels([band.wavelength for band in found])
    return tuple(replace(band, label=label) for band, label in zip(found, labels, strict=True))


def _blocks(
    layers: Sequence[LayerArray], picked: Sequence[np.ndarray], bands: tuple[Band, ...], gain: float
) -> Iterator[Cube]:
    gains = (np.float32(1), np.float32(gain))
    with_sigma = any(layer.sigma is not None for layer in layers)
    for start in range(0, layers[0].shape[0], ROWS):
        rows = slice(start, start + ROWS)
        values, flags, sigmas = [], [], []
        for layer, places, by in zip(layers, picked, gains, strict=True):
            part = layer.isel(y=rows, band=places)
            values.append(np.asarray(part.values, np.float32) / by)
            flags.append(layer.flags.isel(y=rows, band=places).values)
            sigma = layer.sigma
            sigmas.append(np.full(values[-1].shape, np.nan, np.float32) if sigma is None
                          else np.asarray(sigma.isel(y=rows, band=places).values, np.float32) / by)  # fmt: skip
        yield Cube(
            np.concatenate(values, 2),
            np.concatenate(flags, 2).astype(np.uint8),
            np.concatenate(sigmas, 2) if with_sigma else None,
            bands,
        )


def _rows_of_budgets(
    budgets: Sequence[LayerBudget],
    pair: Pair,
    picked: Sequence[np.ndarray],
    bands: tuple[Band, ...],
) -> list[dict[str, Any]]:
    """Return the rows of both budgets, of the bands that were taken, under their new labels; each camera's errors stay its own."""
    rows, at = [], 0
    for budget, (key, layer), places in zip(budgets, pair, picked, strict=True):
        # As `uncertain_region` names them: what a layer has in common with one of its sources cancels.
        place, camera = f":{key.object}/{key.name}", f":{key.camera}"
        owners = dict.fromkeys(get_args(Extent), place) | {"camera": camera, "campaign": ""}
        renamed = {str(layer.band.values[i]): bands[at + n].label for n, i in enumerate(places)}
        at += len(places)
        for row in budget.sources:
            size, zero = (
                {renamed[b]: v for b, v in one.items() if b in renamed}
                for one in (row.size, row.zero_at)
            )
            owner = row.owner or owners[row.common_to]
            rows.append(replace(row, size=size, zero_at=zero, owner=owner).to_dict())
    return rows
