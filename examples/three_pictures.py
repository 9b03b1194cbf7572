"""Photograph, infrared and X-ray of a simulated panel: python examples/three_pictures.py panel"""

import sys
from pathlib import Path

import cv2
import numpy as np

from levkas.colour.srgb import encode_srgb
from levkas.simulation.icon import paint_icon
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.pigments import WAVELENGTHS

HEAVY = {"white": 1.0, "red lead": 1.0, "vermilion": 0.9, "yellow": 0.9, "gold": 0.3}
"""Absorption of X-rays by a paint; those mixed with lead white have half of its."""


def reflectance(panel: Painting, centre_nm: float, width_nm: float) -> np.ndarray:
    """Return the reflectance in a band of wavelengths, (rows, columns)."""
    weight = np.exp(-(((WAVELENGTHS - centre_nm) / width_nm) ** 2))
    return (panel.amounts / 255.0) @ (panel.spectra @ weight / weight.sum())


def absorption(panel: Painting) -> np.ndarray:
    """Return the absorption of X-rays by paint and by the grain of the board, (rows, columns)."""
    mixed = [0.5 if "light" in n or n in ("flesh", "pink") else 0.1 for n in panel.names]
    lead = np.array([HEAVY.get(n, m) for n, m in zip(panel.names, mixed, strict=True)])
    y, x = np.indices(panel.amounts.shape[:2])
    rings = np.sin(y / 7 + 3 * np.sin(y / 61) + np.sin(x / 300))
    return 0.15 + 0.7 * (panel.amounts / 255.0) @ lead + 0.02 * rings


def recorded(
    picture: np.ndarray, size: tuple[int, int], turn_deg: float, tilt: float
) -> np.ndarray:
    """Return the picture as a camera of `size` (width, height) sees it, turned and tilted."""
    height, width = picture.shape[:2]
    scale = 0.93 * min(size[0] / width, size[1] / height)
    middle = (width / 2, height / 2)
    turn = np.vstack([cv2.getRotationMatrix2D(middle, turn_deg, scale), [tilt, 0, 1]])
    turn[:2, 2] += np.array(size) / 2 - middle
    soft = cv2.GaussianBlur(picture, None, 0.45 / scale)
    return cv2.warpPerspective(soft, turn, size, flags=cv2.INTER_AREA, borderValue=(0.02,) * 3)


def write(path: Path, picture: np.ndarray, rng: np.random.Generator) -> None:
    """Write a picture of values from 0 to 1 with 8 bits and noise of one count."""
    path.parent.mkdir(parents=True, exist_ok=True)
    counts = np.clip(255 * picture + rng.normal(0, 1, picture.shape), 0, 255).round()
    cv2.imwrite(str(path), counts.astype(np.uint8))


def main(folder: Path) -> None:
    rng = np.random.default_rng(4)
    panel = paint_icon(Panel(), 3.0, rng)
    colour = np.stack([reflectance(panel, nm, 30) for nm in (460, 540, 610)], -1)
    infrared = reflectance(panel, 980, 40) * (1 - 0.7 * panel.underdrawing / 255)
    upright = [np.rot90(p, -1).copy() for p in (colour, infrared, absorption(panel))]
    photograph = encode_srgb(recorded(upright[0], (900, 1200), 0.4, 8e-6)) / 255
    write(folder / "photo/panel.png", photograph, rng)
    write(folder / "infrared/panel.png", recorded(upright[1], (640, 800), -1.5, -2e-5), rng)
    write(folder / "xray/panel.png", recorded(upright[2], (760, 980), 2.0, 0.0), rng)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
