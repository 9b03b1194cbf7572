"""Planned exposure of every camera and channel: times, electrons, SNR.

A pixel gathers e = t·p²·τ / (4·N²·(1+m)²) · ∫ E(λ)·Rw·QE(λ)·λ/(hc) dλ photo-electrons from a white
board, with the irradiance E, the lens's transmittance τ and f-number N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.noise_model import Sensor, snr_db
from levkas.planning.framing import magnification
from levkas.planning.setup import illuminate
from levkas.planning.spectra import GRID, LUMENS_PER_WATT, steps
from levkas.planning.tables import PlanRefused, value_problem

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioCamera, StudioSetup

PLANCK_TIMES_LIGHT = 1.98644586e-25
"""h·c, J·m."""


@dataclass(frozen=True)
class Channel:
    """One channel's exposure of a white board.

    `snr` is the linear mean over spread after flat-fielding.
    """

    name: str
    wavelength: float
    sensor: str
    time_s: float
    electrons: float
    share_of_full: float
    snr: float
    snr_db: float
    too_long: bool = False


@dataclass(frozen=True, eq=False)
class CameraExposure:
    """The channels of one camera under one lighting."""

    camera: str
    setup: str
    channels: tuple[Channel, ...]
    limiting: str
    evenness: float
    total_s: float
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "camera": self.camera,
            "setup": self.setup,
            "channels": [dict(c.__dict__) for c in self.channels],
            "limiting": self.limiting,
            "evenness": self.evenness,
            "total_s": self.total_s,
            "notes": list(self.notes),
        }


def plan_exposure(setup: StudioSetup, name: str | None = None) -> list[CameraExposure]:
    """Return the exposure of every camera under one lighting of a setup file.

    Parameters
    ----------
    name : str, optional
        Of the lighting; the first without one.
    """
    lighting = setup.lighting(name)
    spectrum = irradiance_spectrum(setup, lighting)
    return [expose_camera(setup, camera, lighting, spectrum) for camera in setup.cameras.values()]


def irradiance_spectrum(setup: StudioSetup, lighting: Lighting) -> np.ndarray:
    """Return the spectral irradiance at the object's middle, W/m²/nm at `spectra.GRID`."""
    up = np.array([0.0, 0.0, 1.0])
    parts = [float(illuminate([lamp], np.zeros(3), up)) for lamp in lighting.lamps]
    if lighting.illuminance_lx is None and not all(x.measured for x in lighting.lamps):
        raise PlanRefused(
            value_problem(
                str(setup.path), f"setups.{lighting.name}.illuminance_lx",
                "the strength of the light is unknown", "no power_w, no illuminance_lx",
                "one of them", "Measure at the object's middle with a lux meter, or give power_w.",
                "E_NO_POWER",
            )
        )  # fmt: skip
    total = sum(parts)
    scale = 1.0 if lighting.illuminance_lx is None else lighting.illuminance_lx / total
    mixed = [lux * lamp.spectrum for lux, lamp in zip(parts, lighting.lamps, strict=True)]
    return scale * np.sum(mixed, axis=0) / LUMENS_PER_WATT


def electron_rates(
    setup: StudioSetup, camera: StudioCamera, lighting: Lighting, spectrum: np.ndarray
) -> np.ndarray:
    """Return photo-electrons a second and pixel of a white board, (channels,).

    Parameters
    ----------
    spectrum : ndarray, (n,)
        Spectral irradiance, W/m²/nm.
    """
    keys, sheets = camera.keys, setup.bench.sheets
    m = magnification(keys.focal_mm, camera.distance_mm)
    stop = keys.lens_transmittance / (4 * (keys.f_number * (1 + m)) ** 2)
    if lighting.camera_polariser and not keys.has_polariser:
        stop *= sheets.transmittance
    area = (keys.pitch_um * 1e-6) ** 2
    photons = spectrum * (GRID * 1e-9) / PLANCK_TIMES_LIGHT * steps()
    return setup.bench.target.white * area * stop * (camera.quantum @ photons)


def expose_camera(
    setup: StudioSetup, camera: StudioCamera, lighting: Lighting, spectrum: np.ndarray
) -> CameraExposure:
    """Return the exposure of one camera: the brightest channel of each sensor at the aimed share."""
    keys, target = camera.keys, setup.bench.target
    rates = electron_rates(setup, camera, lighting, spectrum)
    wanted = target.share_of_full * keys.full_well_e
    times = np.full(len(rates), 0.0)
    sensors = _sensors(camera)
    for members in sensors.values():
        index = np.array(members)
        free = keys.exposure == "per band"
        best = wanted / np.maximum(rates[index] if free else rates[index].max(), 1e-12)
        times[index] = np.minimum(best, keys.longest_s)
    owner = {i: name for name, members in sensors.items() for i in members}
    channels = tuple(
        _channel(camera, i, owner[i], float(times[i]), float(rates[i])) for i in range(len(rates))
    )
    snrs = [c.snr for c in channels]
    weakest = channels[int(np.argmin(snrs))]
    per_sensor = [times[np.array(m)] for m in sensors.values()]
    free = keys.exposure == "per band"
    total = float(sum(t.sum() for t in per_sensor) if free else max(t.max() for t in per_sensor))
    notes = tuple(_notes(camera, channels, weakest))
    return CameraExposure(
        camera.name, lighting.name, channels, weakest.name, max(snrs) / max(min(snrs), 1e-9), total,
        notes,
    )  # fmt: skip


def _sensors(camera: StudioCamera) -> dict[str, list[int]]:
    """Channels that share an exposure time, by sensor."""
    if not camera.keys.sensors:
        return {"": list(range(len(camera.labels)))}
    return {
        f"sensor {i + 1}": [camera.labels.index(label) for label in labels]
        for i, labels in enumerate(camera.keys.sensors)
    }


def _channel(camera: StudioCamera, i: int, sensor: str, time_s: float, rate: float) -> Channel:
    keys = camera.keys
    electrons = rate * time_s
    dark = keys.dark_e_per_s * time_s
    flat = Sensor(dark, keys.read_e, 0.0, 0.0, full_well=keys.full_well_e)
    held = min(electrons, keys.full_well_e)
    decibel = float(snr_db(held, flat))
    return Channel(
        camera.labels[i], float(camera.wavelengths[i]), sensor, time_s, electrons,
        electrons / keys.full_well_e, float(10 ** (decibel / 10)), decibel,
        time_s >= keys.longest_s,
    )  # fmt: skip


def _notes(
    camera: StudioCamera,
    channels: tuple[Channel, ...],
    weakest: Channel,
) -> list[str]:
    """Describe what limits or saturates, and what is assumed."""
    notes = []
    if camera.keys.sensitivity is None:
        where = (
            "in every band" if camera.keys.wavelengths else "from 400 to 720 nm, one grey channel"
        )
        notes.append(
            f"No sensitivity is given: {100 * camera.keys.peak_qe:g} % of the photons are assumed to count {where}."
        )
    full = [c for c in channels if c.share_of_full >= 1]
    if full:
        notes.append(
            f"{', '.join(c.name for c in full)} would saturate: a white board fills "
            f"{100 * max(c.share_of_full for c in full):.0f} % of the well."
        )
    ratio = max(c.share_of_full for c in channels) / max(weakest.share_of_full, 1e-12)
    if ratio > 1.5:
        notes.append(
            f"{weakest.name} limits: it gets {ratio:.1f} times less light than the fullest channel, "
            f"SNR {weakest.snr:.0f} ({weakest.snr_db:.1f} dB, 10·log10) on white."
        )
    long = [c.name for c in channels if c.too_long]
    if long:
        notes.append(f"{', '.join(long)} would need more than {camera.keys.longest_s:g} s.")
    return notes
