"""Aligning all the bands of one sensor: one base map that they share, and what sets each apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Composed, Transform
from levkas.registration.coarse_to_fine import refine
from levkas.registration.initial import start
from levkas.registration.manual_points import Given
from levkas.registration.record import RegistrationRefused
from levkas.registration.seeded import guide
from levkas.registration.task import Task
from levkas.registration.uncertainty import Sigma, measure_sigma

if TYPE_CHECKING:
    from levkas.registration.checks import Checks
    from levkas.registration.chromatic import Chromatic
    from levkas.registration.images import BandImage
    from levkas.registration.initial import Start
    from levkas.registration.key_points import KeyPictures
    from levkas.registration.local_shifts import Windows
    from levkas.registration.model_selection import Rung
    from levkas.registration.predictors import Scene


@dataclass(frozen=True)
class Sensor:
    """One sensor registered.

    Parameters
    ----------
    name : str
    transforms : dict of label to Transform
    base : Transform
    chromatic : Chromatic
    rung : Rung or None
        The ladder's choice for the base map; None for the reference's own sensor.
    windows : dict of label to Windows
        Shifts that the last round saw, before its correction.
    start : Start or None
    step : int
        Reference px per px of the grid on which it was judged.
    evidence : dict
        How far its best band is predicted above chance.
    climbs : list of dict
        What the ladder saw and took at each step, from coarse to fine, JSON-ready.
    borne_out : dict
        What `corroborate` measured of it; empty for the reference's own sensor.
    sigma : dict of label to Sigma
    checks : Checks or None
        Windows that were looked for freely; None for the reference's own sensor.
    course : dict
        How many rounds it took, and whether it came to rest; empty for the reference's own sensor.
    alike : bool
        Whether it sees light of wavelengths that the reference sees too.
    """

    name: str
    transforms: dict[str, Transform]
    base: Transform
    chromatic: Chromatic
    rung: Rung | None
    windows: dict[str, Windows]
    start: Start | None = None
    step: int = 1
    evidence: dict[str, float] = field(default_factory=dict)
    climbs: list[dict[str, Any]] = field(default_factory=list)
    borne_out: dict[str, Any] = field(default_factory=dict)
    sigma: dict[str, Sigma] = field(default_factory=dict)
    checks: Checks | None = None
    course: dict[str, Any] = field(default_factory=dict)
    alike: bool = False


def ordered(bands: Sequence[BandImage]) -> list[BandImage]:
    """Return the bands by wavelength where all are known, else as they come."""
    known = all(np.isfinite(band.wavelength) for band in bands)
    return sorted(bands, key=lambda band: band.wavelength) if known else list(bands)


def align_sensor(
    bands: Sequence[BandImage],
    images: Mapping[str, np.ndarray],
    scene: Scene,
    ours: KeyPictures,
    theirs: KeyPictures,
    given: Given | None = None,
    known: Mapping[str, Sigma] | None = None,
) -> Sensor:
    """Register the bands of one sensor of another camera to the scene.

    Parameters
    ----------
    bands : sequence of BandImage
        Of the sensor.
    images : mapping of label to ndarray
        As `images_of` gives them.
    scene : Scene
    ours, theirs : KeyPictures
        Of the reference and of the sensor.
    given : Given, optional
        Pairs by hand: they start it where key points do not, and weigh as a hand can point.
    known : mapping of label to Sigma, optional
        How well the reference's own bands are known to lie.

    Raises
    ------
    RegistrationRefused
        ``E_MATCHES``, ``E_WINDOWS`` or ``E_FOLD``.
    """
    found = start(ours, theirs)
    given = given or Given()
    if given:
        found = guide(found, given, ours, theirs)
    if found is None:
        raise RegistrationRefused(
            Problem(
                "E_MATCHES",
                "too few key points agree on any map of this sensor to the reference",
                field=bands[0].sensor or None,
                fix="Check that both show the same object, in focus and well exposed; give control "
                "points if they do.",
            )
        )
    bands = ordered(bands)
    within = np.ones(scene.shape, bool) if ours.within is None else ours.within
    got = refine(Task(bands, images, scene, within, found, given))
    transforms: dict[str, Transform] = {
        band.label: Composed(got.model.transform(i), got.base) for i, band in enumerate(bands)
    }
    seen = {band.label: windows for band, windows in zip(bands, got.seen, strict=True)}
    return Sensor(
        bands[0].sensor, transforms, got.base, got.model, got.rung, seen, found, got.step,
        got.evidence, got.climbs, got.borne_out,
        measure_sigma(
            scene.shape, [band.label for band in bands], got.model, got.rung, known,
            checks=got.checks,
        ),
        got.checks, got.course, got.alike,
    )  # fmt: skip
