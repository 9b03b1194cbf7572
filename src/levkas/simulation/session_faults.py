"""Faults of a session, planted into frames that are sound: what a lamp, a lens, a stage or a person does to the codes.

Each is made in light: what is brighter is scaled above the black level, what is darker has the noise of less light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PlantedFault:
    """One kind of fault at two sizes.

    Parameters
    ----------
    kind : str
    check : str
        The check of `levkas.quality.frame_checks` that is to name it.
    role : {"object", "white", "dark"}
        Of the frame that it is planted into.
    sizes : (float, float)
        Small and large, in the fault's own unit.
    stack : bool
        Whether it shows against other shots of the same scene alone.
    """

    kind: str
    check: str
    role: str
    sizes: tuple[float, float]
    stack: bool = False


FAULTS = (
    PlantedFault("white clipped, share", "exposure", "white", (0.005, 0.3)),
    PlantedFault("object clipped, share", "exposure", "object", (0.02, 0.2)),
    PlantedFault("object too dark, loss", "exposure", "object", (0.98, 0.995)),
    PlantedFault("light in the dark, of full scale", "dark", "dark", (0.03, 0.4)),
    PlantedFault("black level, of full scale", "black", "dark", (0.008, 0.03), stack=True),
    PlantedFault("dark of another time, ratio", "dark", "object", (2.0, 20.0)),
    PlantedFault("painting in the white, share", "white", "white", (0.25, 1.0)),
    PlantedFault("shading of a white, change", "white", "white", (0.08, 0.4)),
    PlantedFault("lamp between whites, loss", "drift", "white", (0.04, 0.12)),
    PlantedFault("lamp within a stack, loss", "drift", "object", (0.02, 0.1), stack=True),
    PlantedFault("noise of a white, times", "noise", "white", (1.6, 3.0)),
    PlantedFault("noise reduction, share taken", "noise", "white", (0.4, 0.7)),
    PlantedFault("noise of a shot, times", "noise", "object", (1.6, 3.0), stack=True),
    PlantedFault("defocus, px", "focus", "object", (1.8, 4.0), stack=True),
    PlantedFault("glare, share", "glare", "object", (0.02, 0.1)),
    PlantedFault("moved, px", "moved", "object", (2.0, 20.0), stack=True),
    PlantedFault("object at a side, share beyond", "framing", "object", (0.0, 0.15)),
    PlantedFault("dust, depth", "dust", "white", (0.15, 0.5)),
    PlantedFault("another ISO, ratio", "settings", "object", (2.0, 8.0)),
    PlantedFault("another f-number, ratio", "settings", "object", (1.4, 4.0)),
    PlantedFault("another white balance, gain", "settings", "object", (1.0, 1.5)),
    PlantedFault("another size, share", "settings", "object", (0.01, 0.5)),
    PlantedFault("file cut short, share", "file", "object", (0.01, 0.6)),
    PlantedFault("file twice", "twice", "object", (1.0, 1.0), stack=True),
)


@dataclass(frozen=True)
class FrameLevels:
    """What of a camera a fault must know, counts; `period` of the mosaic, px."""

    black: float
    full: float
    period: int = 1


def plant_fault(
    fault: PlantedFault,
    size: float,
    codes: np.ndarray,
    levels: FrameLevels,
    rng: np.random.Generator,
    *,
    beside: np.ndarray | None = None,
) -> np.ndarray:
    """Return the codes of a frame with a fault; those of faults of files and settings are unchanged.

    Parameters
    ----------
    fault : PlantedFault
    size : float
        In the unit of the fault.
    codes : ndarray, (h, w), uint16
    levels : FrameLevels
    rng : Generator
    beside : ndarray, (h, w), optional
        Of a white the object, of an object the white.

    Examples
    --------
    >>> white, lamp = np.full((40, 60), 1064, np.uint16), next(f for f in FAULTS if f.kind[:4] == "lamp")
    >>> found = plant_fault(lamp, 0.04, white, FrameLevels(64, 4095), np.random.default_rng(1))
    >>> lamp.kind, round(float(found.mean()))
    ('lamp between whites, loss', 1024)
    """
    light = codes.astype(np.float64) - levels.black
    maker = _MAKERS.get(fault.kind.partition(",")[0])
    if maker is None:
        return codes
    made = maker(light, size, levels, rng, beside)
    return np.round(made + levels.black).clip(0, levels.full).astype(codes.dtype)


Maker = Callable[
    [np.ndarray, float, FrameLevels, np.random.Generator, "np.ndarray | None"], np.ndarray
]


def _clipped(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Scale until a share of the brightest phase is at full scale."""
    p = levels.period
    tops = [np.quantile(light[y::p, x::p], 1 - share) for y in range(p) for x in range(p)]
    return light * ((levels.full - levels.black) / max(max(tops), 1.0)) * 1.002


def _lit(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    return light + share * levels.full * np.linspace(0, 1, light.shape[1])


def _lifted(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    return light + share * levels.full


def _covered(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Put the object in place of the board over some columns; dimmed a little, so that it is another frame."""
    columns = np.arange(light.shape[1]) < share * light.shape[1]
    return np.where(columns, 0.97 * (beside - levels.black), light)


def _dimmed(light, loss, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Take a share of the light away; the variance that scaling takes too much is put back."""
    noise = _noise(light, levels.period)
    return (1 - loss) * light + rng.normal(0, noise * np.sqrt(loss * (1 - loss)), light.shape)


def _shaded(light, change, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Tilt the light from one side to the other."""
    return light * np.linspace(1, 1 - change, light.shape[1])


def _noisier(light, times, levels, rng, beside):  # type: ignore[no-untyped-def]
    own = _noise(light, levels.period)
    return light + rng.normal(0, own * np.sqrt(times**2 - 1), light.shape)


def _smoothed(light, taken, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Take a share of the noise away, as noise reduction does, phase by phase."""
    smooth = _filtered(light, 2.0, levels.period)
    return smooth + (1 - taken) * (light - smooth)


def _blurred(light, sigma, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Blur each phase; the noise that blurring takes away is put back."""
    blurred = _filtered(light, sigma / levels.period, levels.period)
    return blurred + rng.normal(0, _noise(light, levels.period), light.shape)


def _filtered(light: np.ndarray, sigma: float, p: int) -> np.ndarray:
    """Return a frame whose phases are blurred by a Gaussian, px of a phase."""
    from scipy.ndimage import gaussian_filter

    made = light.copy()
    for y in range(p):
        for x in range(p):
            made[y::p, x::p] = gaussian_filter(light[y::p, x::p], sigma, mode="nearest")
    return made


def _glaring(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Lift a square to 1.3 times the white, as far as the scale reaches."""
    side = [int(n * np.sqrt(share)) for n in light.shape]
    made, (y, x) = light.copy(), (n // 3 for n in light.shape)
    part = slice(y, y + side[0]), slice(x, x + side[1])
    made[part] = 1.3 * (beside - levels.black)[part]
    return made


def _moved(light, distance, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Move by whole periods, so that the mosaic stays."""
    step = max(1, round(distance / levels.period)) * levels.period
    return np.pad(light, ((0, 0), (step, 0)), mode="symmetric")[:, : light.shape[1]]


def _at_a_side(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Move the object to the left until a share of the width of the frame is beyond it; the wall on the right goes on."""
    p, width = levels.period, light.shape[1]
    columns = _filtered(light, 1.0, p).mean(0)
    apart = np.abs(columns - np.median(columns[: width // 50]))
    shown = np.flatnonzero(apart > 0.1 * apart.max())
    step = round((shown[0] + share * width) / p) * p
    wall = (width - shown[-1]) // (2 * p) * p
    more = np.tile(light[:, -wall:], -(-step // wall))
    return np.concatenate([light[:, step:], more], 1)[:, :width]


def _balanced(light, gain, levels, rng, beside):  # type: ignore[no-untyped-def]
    """Multiply the first phase of a mosaic, red, and divide the last, blue, as programs do that balance raw values."""
    p, made = levels.period, light.copy()
    if p > 1:
        made[::p, ::p] *= gain
        made[p - 1 :: p, p - 1 :: p] /= gain
    return made


def _dusty(light, depth, levels, rng, beside):  # type: ignore[no-untyped-def]
    y, x = np.indices(light.shape)
    radius = 0.008 * max(light.shape)
    away = (x - 0.63 * light.shape[1]) ** 2 + (y - 0.31 * light.shape[0]) ** 2
    return light * (1 - depth * np.exp(-away / (2 * radius**2)))


def _cropped(light, share, levels, rng, beside):  # type: ignore[no-untyped-def]
    rows = max(1, int(light.shape[0] * share / levels.period)) * levels.period
    return light[: light.shape[0] - rows]


_MAKERS: dict[str, Maker] = {
    "white clipped": _clipped,
    "object clipped": _clipped,
    "object too dark": _dimmed,
    "shading of a white": _shaded,
    "light in the dark": _lit,
    "black level": _lifted,
    "painting in the white": _covered,
    "lamp between whites": _dimmed,
    "lamp within a stack": _dimmed,
    "noise of a white": _noisier,
    "noise of a shot": _noisier,
    "noise reduction": _smoothed,
    "object at a side": _at_a_side,
    "another white balance": _balanced,
    "defocus": _blurred,
    "glare": _glaring,
    "moved": _moved,
    "dust": _dusty,
    "another size": _cropped,
}


def _noise(light: np.ndarray, period: int) -> float:
    """Return the standard deviation from pixel to pixel of one phase."""
    apart = light[:, : -2 * period] - 2 * light[:, period:-period] + light[:, 2 * period :]
    return 1.4826 * float(np.median(np.abs(apart))) / float(np.sqrt(6))
