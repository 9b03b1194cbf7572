"""Spectra to sRGB under another illuminant, with chromatic adaptation.

With S the light's spectrum, XYZ = Σ S x̄ R / Σ S ȳ; its white is then brought to that of D65 by the
Bradford transform, so that a perfect diffuser stays white and only what the light does to the
paints is seen. The tables are kept here because colour-science, which the tests compare them with,
takes seconds to import.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.observer import tables_by_nm
from levkas.colour.srgb import SRGB_TO_XYZ

if TYPE_CHECKING:
    from collections.abc import Sequence

ILLUMINANTS = {
    "D50": "D50, daylight in the morning",
    "A": "A, incandescent lamp",
    "LED-B3": "LED-B3, white LED of 4100 K",
    "FL2": "FL2, fluorescent tube",
}
"""CIE illuminants beside D65, and what they are."""
# nm, then the illuminants in their order (CIE 15:2018), every fifth nanometre.
TABLE = """
380 24.488 9.7951 0 1.18
385 27.179 10.8996 0 1.48
390 29.871 12.0853 0.01 1.84
395 39.589 13.3543 0.02 2.15
400 49.308 14.708 0.05 3.44
405 52.91 16.148 0.11 15.69
410 56.513 17.6753 0.25 3.85
415 58.273 19.2907 0.56 3.74
420 60.034 20.995 1.2 4.19
425 58.926 22.7883 2.37 4.62
430 57.818 24.6709 4.24 5.06
435 66.321 26.6425 7.17 34.98
440 74.825 28.7027 12.11 11.81
445 81.036 30.8508 17.7 6.27
450 87.247 33.0859 18.87 6.63
455 88.93 35.4068 14.58 6.93
460 90.612 37.8121 9.9 7.19
465 90.99 40.3002 7.53 7.4
470 91.368 42.8693 6.02 7.54
475 93.238 45.5174 5.11 7.62
480 95.109 48.2423 5.17 7.65
485 93.536 51.0418 5.82 7.62
490 91.963 53.9132 6.77 7.62
495 93.843 56.8539 7.88 7.45
500 95.724 59.8611 8.94 7.28
505 96.169 62.932 9.82 7.15
510 96.613 66.0635 10.52 7.05
515 96.871 69.2525 11.06 7.04
520 97.129 72.4959 11.51 7.16
525 99.614 75.7903 11.93 7.47
530 102.099 79.1326 12.37 8.04
535 101.427 82.5193 12.83 8.88
540 100.755 85.947 13.31 10.01
545 101.536 89.4124 13.79 24.88
550 102.317 92.912 14.26 16.64
555 101.159 96.4423 14.68 14.59
560 100 100 15.08 16.16
565 98.868 103.582 15.42 17.56
570 97.735 107.184 15.72 18.62
575 98.327 110.803 15.97 21.47
580 98.918 114.436 16.18 22.79
585 96.208 118.08 16.37 19.29
590 93.499 121.731 16.5 18.66
595 95.593 125.386 16.55 17.73
600 97.688 129.043 16.5 16.54
605 98.478 132.697 16.32 15.21
610 99.269 136.346 16 13.8
615 99.155 139.988 15.54 12.36
620 99.042 143.618 14.96 10.95
625 97.382 147.235 14.27 9.65
630 95.722 150.836 13.48 8.4
635 97.29 154.418 12.62 7.32
640 98.857 157.979 11.71 6.31
645 97.262 161.516 10.78 5.43
650 95.667 165.028 9.85 4.68
655 96.929 168.51 8.93 4.02
660 98.19 171.963 8.04 3.45
665 100.597 175.383 7.2 2.96
670 103.003 178.769 6.42 2.55
675 101.068 182.118 5.69 2.19
680 99.133 185.429 5.02 1.89
685 93.257 188.701 4.42 1.64
690 87.381 191.931 3.88 1.53
695 89.492 195.118 3.39 1.27
700 91.604 198.261 2.95 1.1
705 92.246 201.359 2.56 0.99
710 92.889 204.409 2.22 0.88
715 84.872 207.411 1.92 0.76
720 76.854 210.365 1.65 0.68
725 81.683 213.268 1.43 0.61
730 86.511 216.12 1.23 0.56
735 89.546 218.92 1.06 0.54
740 92.58 221.667 0.91 0.51
745 85.405 224.361 0.78 0.47
750 78.23 227 0.68 0.47
755 67.961 229.585 0.58 0.43
760 57.692 232.115 0.5 0.46
765 70.307 234.589 0.43 0.47
770 82.923 237.008 0.37 0.4
775 80.599 239.37 0.32 0.33
780 78.274 241.675 0.28 0.27
"""
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def relighting_matrix(wavelengths: Sequence[float] | np.ndarray, illuminant: str) -> np.ndarray:
    """Return the matrix from narrow bands to linear sRGB under an illuminant.

    Parameters
    ----------
    wavelengths : (bands,), nm
    illuminant : str
        A name of `ILLUMINANTS`.

    Returns
    -------
    matrix : ndarray, (bands, 3), float32
        ``linear = reflectance @ matrix``; reflectance 1 in all bands gives 1, 1, 1.
    """
    centres = np.asarray(wavelengths, float)
    order = np.argsort(centres, kind="stable")
    grid = tables_by_nm()[:, 0]
    hats = np.stack([np.interp(grid, centres[order], row) for row in np.eye(len(centres))])
    weights = np.empty((len(centres), 3))
    weights[order] = hats @ observer_under(illuminant)
    adapted = weights @ _adaptation(weights.sum(0)).T
    return (adapted @ np.linalg.inv(SRGB_TO_XYZ).T).astype(np.float32)


@cache
def observer_under(illuminant: str) -> np.ndarray:
    """Return the CIE 1931 2° observer times a light, (401, 3), 380 to 780 nm; Y sums to 1."""
    rows = tables_by_nm()
    table = np.array([[float(cell) for cell in line.split()] for line in TABLE.split("\n") if line])
    column = 1 + list(ILLUMINANTS).index(illuminant)
    power = np.interp(rows[:, 0], table[:, 0], table[:, column])
    weights = rows[:, 1:4] * power[:, None]
    return weights / weights[:, 1].sum()


def _adaptation(white: np.ndarray) -> np.ndarray:
    """Bradford's matrix from `white` to that of D65."""
    gains = (BRADFORD @ SRGB_TO_XYZ.sum(1)) / (BRADFORD @ white)
    return np.linalg.inv(BRADFORD) @ np.diag(gains) @ BRADFORD
