"""Real captures calibrated; each number was looked at by a person beside the picture."""

import cv2
import numpy as np

from levkas.calibration.defects import find_defects, replace_defects
from levkas.calibration.flatfield import flat_field
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import fit_noise
from levkas.calibration.templates import average
from levkas.calibration.whites import WhiteBoard

NINE = [[f"B{3 * y + x + 1}" for x in range(3)] for y in range(3)]


def test_a_nine_band_mosaic_leaves_no_grid(real_data):
    def frame(name):
        path = real_data / "silios-kinect" / name
        return average([cv2.imread(str(path), cv2.IMREAD_UNCHANGED)], saturation=255)

    dark, white = (frame(f"{t}/2020511_multispectral_camera.png") for t in ("dark", "flat"))
    scene = frame("scene1/2020511_multispectral_camera.png")
    defects = find_defects(dark, white, NINE)
    assert np.count_nonzero(defects) == 52
    made = flat_field(scene, dark, white, board=WhiteBoard(pattern=NINE), defects=defects)
    values, flags, _ = replace_defects(made.values, made.flags, None, NINE)
    channels, _, _ = demosaic(values, flags, None, NINE)
    # Means over the nine phases of each channel; raw phases differ by 5 %.
    phases = np.array([channels[y::3, x::3].mean((0, 1)) for y in range(3) for x in range(3)])
    assert np.all(phases.std(0) / phases.mean(0) < 0.001)


def test_a_real_line_scan_becomes_reflectance(real_data):
    def scan(name):
        raw = np.fromfile(real_data / "envi-linescan" / f"{name}.raw", "<u2")
        return raw.reshape(31, 580, 43).transpose(0, 2, 1)

    white, dark = (average(scan(f"{t}_reference_crop")[:, None]) for t in ("white", "dark"))
    made = flat_field(
        average([scan("4-22-22_right_same_B73_top_00")]),
        dark,
        white,
        noise=fit_noise([white, dark], [dark]),
    )
    middle = np.median(made.values, (0, 1))
    # Dark at 440 nm, brighter in the infrared; sigma below 2 % of white where the lamp is strong.
    assert 0.08 < middle[60] < 0.15
    assert 0.4 < middle[420] < 0.55
    sigma = np.sqrt(np.median(made.variance, (0, 1)))
    assert sigma[120:480].max() < 0.02
