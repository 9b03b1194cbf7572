"""Spectra of bands: what a camera's channels are sensitive to, and what a white reflects in them."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import find_band
from levkas.core.problems import Problem, Refused
from levkas.core.text import TextRefused, read_text
from levkas.database.credits import Credits
from levkas.readers.spectra import are_spectra, parse_spectra

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, SensorFrames
    from levkas.core.cube import Band

VISIBLE = (400.0, 700.0)
MOST_OF_BOARD, LEAST_OF_BOARD = 0.1, 2e-4
"""Standard uncertainty of a white board, relative: more is none (0.5 is meant in per cent, 0.98 is a reflectance), and no laboratory
certifies less than a part in a thousand; half or twice of either changes what is refused in no certificate."""
COVERED = 0.98
"""Share of a band's sensitivity over which a spectrum must be known."""
UNEVEN = 0.005
"""Of a board over the visible, relative: less is no more than its calibration is worth."""
LOWEST_NM = 100.0


class SpectrumRefused(Refused):
    """A spectrum that cannot be read or does not cover the bands."""


def reference_channel(
    campaign: Campaign, camera: str, bands: Sequence[Band], wavelength: float
) -> str:
    """Return the band meant by `CAMERA` without a band.

    The declared `reference_band`, else the band whose wavelength (or sensitivity's centroid) is nearest to `wavelength`, that of
    the reference band, else the middle one as declared.
    """
    keys = campaign.cameras[camera]
    labels = [band.label for band in bands]
    if keys.reference_band:
        return labels[find_band(labels, keys.reference_band, [b.wavelength for b in bands])]
    centres = [band.wavelength for band in bands]
    if any(isnan(c) for c in centres) and keys.sensitivity:
        wavelengths, table = read_sensitivity(campaign.root / keys.sensitivity, labels)
        centres = list(centroids(wavelengths, table))
    distances = np.abs(np.array(centres, float) - wavelength)
    distances[[band.bad for band in bands]] = np.nan
    if isnan(wavelength) or np.isnan(distances).all():
        return middle_band(bands)
    return labels[int(np.nanargmin(distances))]


def middle_band(bands: Sequence[Band]) -> str:
    """Return the label of the band in the middle, of those that are not bad."""
    good = [band.label for band in bands if not band.bad] or [band.label for band in bands]
    return good[len(good) // 2]


def broad_centroids(campaign: Campaign, camera: str, bands: Sequence[Band]) -> dict[str, float]:
    """Return the centroids of a camera's channels without a centre wavelength, nm, by label; `bands` are those of every sensor.

    Empty where no sensitivities are declared; without a channel that nothing reaches.

    Raises Refused where the declared table cannot be read.
    """
    declared = campaign.cameras[camera].sensitivity
    broad = [band.label for band in bands if isnan(band.wavelength)]
    if not declared or not broad:
        return {}
    labels = [band.label for band in bands]
    found = centroids(*read_sensitivity(campaign.root / declared, labels))
    known = dict(zip(labels, found.tolist(), strict=True))
    return {label: known[label] for label in broad if not isnan(known[label])}


def centroids(wavelengths: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the centroid of each sensitivity, nm.

    >>> centroids(np.array([500.0, 600.0]), np.array([[1.0], [3.0]])).tolist()
    [575.0]
    """
    weights = np.maximum(table, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((wavelengths[:, None] * weights).sum(0) / weights.sum(0))


class BandWeights(NamedTuple):
    """How much a band sees of each wavelength: `wavelengths` (n,) nm and `weights` (n,), any unit."""

    wavelengths: np.ndarray
    weights: np.ndarray

    def mean_of(self, wavelengths: np.ndarray, spectra: np.ndarray) -> np.ndarray:
        """Return means of spectra, (…, n) at rising `wavelengths`, as the band sees them; beyond, as at the ends."""
        rows = np.atleast_2d(spectra)
        near = np.array([np.interp(self.wavelengths, wavelengths, row) for row in rows])
        return np.asarray((near @ self.weights / self.weights.sum()).reshape(spectra.shape[:-1]))


def weights_of_bands(
    campaign: Campaign, capture: Capture, bands: Sequence[Band]
) -> list[BandWeights | None]:
    """Return what each of some bands of one sensor sees of every wavelength; None of a channel of unknown sensitivity.

    The declared `sensitivity`, times the spectrum of the setup's light where one is declared; else a Gaussian of the band's width
    times that light; else its wavelength alone.

    Raises Refused where a declared table cannot be read.
    """
    setup = campaign.setups.get(capture.setup or campaign.campaign.setup or "default")
    lamp = np.array([[0.0, 1.0]])  # any light is as good
    if setup is not None and setup.spectrum is not None:
        lamp = read_table(campaign.root / setup.spectrum)
    table: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    if declared := campaign.cameras[capture.camera].sensitivity:
        labels = [band.label for band in capture.bands]
        wavelengths, columns = read_sensitivity(campaign.root / declared, labels)
        wide = np.arange(wavelengths[0], wavelengths[-1] + 0.5, 1.0)
        for label, column in zip(labels, columns.T, strict=True):
            table[label] = wide, np.maximum(np.interp(wide, wavelengths, column), 0)
    found: list[BandWeights | None] = []
    for band in bands:
        centre, width = band.wavelength, band.fwhm
        if band.label in table:
            wide, weights = table[band.label]
        elif isnan(centre):
            found.append(None)
            continue
        elif isnan(width):
            found.append(BandWeights(np.array([centre]), np.ones(1)))
            continue
        else:
            wide = centre + np.arange(-1.5, 1.51, 0.05) * width
            weights = np.exp(-4 * np.log(2) * ((wide - centre) / width) ** 2)
        weights = weights * np.interp(wide, lamp[:, 0], lamp[:, 1])
        found.append(BandWeights(wide, weights) if weights.sum() > 0 else None)
    return found


class BoardInBands(NamedTuple):
    """Reflectance of the white board, one number or one a band, and what is in doubt of it."""

    reflectance: float | np.ndarray
    notes: tuple[str, ...] = ()


def board_of(campaign: Campaign, capture: Capture, sensor: SensorFrames) -> BoardInBands:
    """Return the reflectance of the white board as the bands of a sensor see it; a channel of unknown sensitivity takes the mean over 400–700 nm.

    Raises Refused: SpectrumRefused where the CSV of the board cannot be used.
    """
    white, bands = campaign.targets.white, sensor.bands
    declared = white.reflectance if white and sensor.white else 1.0
    if not isinstance(declared, str):
        return BoardInBands(1.0 if declared is None else float(declared))
    wavelengths, values, _ = read_certificate(campaign.root / declared)
    first, last = float(wavelengths[0]), float(wavelengths[-1])
    known = [band.wavelength for band in bands if not isnan(band.wavelength)]
    if known and (min(known) < first - 1 or max(known) > last + 1):
        raise SpectrumRefused(
            Problem(
                "E_VALUE",
                "the white's spectrum does not cover the bands",
                file=str(campaign.root / declared),
                field="wavelength",
                found=f"{first:g} to {last:g} nm",
                expected=f"{min(known):g} to {max(known):g} nm",
                fix="Give a spectrum that covers every band.",
            )
        )
    visible = (wavelengths >= VISIBLE[0]) & (wavelengths <= VISIBLE[1])
    broad = values[visible] if visible.any() else values
    found, unknown, beyond = [], [], {}
    for band, weights in zip(bands, weights_of_bands(campaign, capture, bands), strict=True):
        if weights is None:
            unknown.append(band.label)
            found.append(float(broad.mean()))
            continue
        found.append(float(weights.mean_of(wavelengths, values)))
        inside = (weights.wavelengths >= first) & (weights.wavelengths <= last)
        share = float(weights.weights[inside].sum() / weights.weights.sum())
        if len(weights.weights) > 1 and share < COVERED:
            beyond[band.label] = share
    notes = []
    apart = float(np.abs(broad / broad.mean() - 1).max())
    if unknown and apart > UNEVEN:
        notes.append(
            f"{', '.join(unknown)}: the white is not the same at every wavelength, and no sensitivity of the camera is "
            f"declared: its mean over 400–700 nm is used, which may be wrong by up to {100 * apart:.2g} %; declare "
            f"`cameras.{capture.camera}.sensitivity`"
        )
    if beyond:
        notes.append(
            f"{', '.join(beyond)}: the white's spectrum covers {100 * min(beyond.values()):.0f} % of the sensitivity; beyond "
            f"{first:g} to {last:g} nm its first and last values are used"
        )
    return BoardInBands(np.array(found), tuple(notes))


def levels_of_board(campaign: Campaign, capture: Capture) -> dict[str, float]:
    """Return the reflectance of the white board in every band of a capture; raises as `board_of`."""
    found: dict[str, float] = {}
    for sensor in capture.sensors:
        levels = np.broadcast_to(board_of(campaign, capture, sensor).reflectance, len(sensor.bands))
        found |= dict(zip((band.label for band in sensor.bands), levels.tolist(), strict=True))
    return found


def read_board_uncertainty(campaign: Campaign, capture: Capture) -> dict[str, float] | None:
    """Return the relative standard uncertainty of the white board in every band of a capture; None where none is stated.

    The third column of the white's CSV has it, in the unit of the second; or `uncertainty` of `targets.white`, a reflectance.

    Raises Refused where the CSV of the board cannot be used.
    """
    white = campaign.targets.white
    if white is None:
        return None
    boards, errors = levels_of_board(campaign, capture), None
    if isinstance(white.reflectance, str):
        wavelengths, _, errors = read_certificate(campaign.root / white.reflectance)
    if errors is not None:
        bands = [band for sensor in capture.sensors for band in sensor.bands]
        weights = weights_of_bands(campaign, capture, bands)
        return {
            band.label: float(errors.mean() if one is None else one.mean_of(wavelengths, errors))
            / boards[band.label]
            for band, one in zip(bands, weights, strict=True)
        }
    if white.uncertainty is None:
        return None
    return {label: float(white.uncertainty) / level for label, level in boards.items()}


def read_certificate(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read the CSV of a white board: wavelength in nm, its reflectance, a share or per cent, and its standard uncertainty, None where it has none.

    Raises SpectrumRefused where it is not that, or the third column is no uncertainty of the second.
    """
    table = read_table(path, columns=3)
    scale = 100.0 if table[:, 1].max() > 2 else 1.0
    wavelengths, values = table[:, 0], table[:, 1] / scale
    if table.shape[1] < 3 or np.isnan(table[:, 2]).all():
        return wavelengths, values, None
    errors = table[:, 2] / scale
    good = np.isfinite(errors) & (errors >= 0) & (errors <= MOST_OF_BOARD * values)
    if scale > 1:  # per cent beside shares
        good &= (errors == 0) | (errors >= LEAST_OF_BOARD * values)
    if not good.all():
        row = int(np.argmin(good))
        raise SpectrumRefused(
            Problem(
                "E_VALUE",
                "the third column of the white's CSV is not its standard uncertainty",
                str(path),
                "targets.white.reflectance",
                ", ".join(f"{number:g}" for number in table[row]),
                "in each row a number from 0 to a tenth of the second column, in its unit",
                "Correct the column, or take it out. A certificate's k = 2 is halved.",
            )
        )
    return wavelengths, values, errors


def read_table(path: Path, columns: int = 2) -> np.ndarray:
    """Read the numbers of a CSV, (n, `columns`) or fewer columns where it has no more: wavelengths in nm, rising, and values as they are.

    Raises SpectrumRefused where it is not that.
    """
    table, _ = _read(path, "a CSV of wavelength in nm and value", columns)
    if not np.isfinite(table[:, :2]).all():
        raise _not_spectra(path, "empty cells", "a number in every cell")
    return table


def read_sensitivity(path: Path, labels: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Read a CSV of wavelength, (n,) nm, made to ascend, and a column a channel, (n, channels); columns by header where it names them all.

    Raises SpectrumRefused where it cannot be read, a wavelength occurs twice, or it has not as many columns as there are channels.
    """
    table, head = _read(path, "a CSV with wavelength in nm and one column per channel", None)
    columns = list(range(1, table.shape[1]))
    if len(head) == table.shape[1] and all(label in head for label in labels):
        columns = [head.index(label) for label in labels]
    if len(columns) != len(labels):
        raise SpectrumRefused(
            Problem(
                "E_BAND_COUNT",
                "the sensitivities do not match the channels",
                str(path),
                found=f"{len(columns)} columns",
                expected=f"{len(labels)}: {', '.join(labels)}",
            )
        )
    return table[:, 0], np.nan_to_num(table[:, columns])


def _read(path: Path, expected: str, columns: int | None) -> tuple[np.ndarray, list[str]]:
    try:
        table, head = parse_spectra(read_text(path, expected), columns=columns)
    except TextRefused as refused:
        raise SpectrumRefused(*refused.problems) from None
    except ValueError as error:
        raise _not_spectra(path, str(error), expected) from error
    if not are_spectra(table) or table[0, 0] < LOWEST_NM:
        rows = f"{len(table)} rows, or wavelengths that are missing, repeated or below {LOWEST_NM:g} nm"
        raise _not_spectra(path, rows, expected)
    return table, head


def _not_spectra(path: Path, found: str, expected: str) -> SpectrumRefused:
    message, fix = "this is not a table of spectra", "Name the correct file, or correct its rows."
    return SpectrumRefused(
        Problem("E_UNREADABLE", message, str(path), found=found, expected=expected, fix=fix)
    )


def credits_of(campaign: Campaign, name: str, captured: str) -> Credits:
    """Return the credits of an object's files; `captured` is the date that its frames say, or empty."""
    facts, described = campaign.objects.get(name), campaign.campaign
    return Credits(
        title=(facts.title if facts else "") or name,
        creator=described.creator,
        date=captured or described.date or "",
        rights=(facts.rights if facts else "") or described.licence,
    )
