"""Raw frames of two cameras to one cube, on arrays alone: python examples/notebook_arrays.py arrays.png

Cells begin with ``# %%``: JupyterLab (with jupytext), Spyder, VS Code and PyCharm open the script as a notebook.
"""

# %% Raw frames of two simulated cameras, as arrays: bands of a filter camera, and a colour mosaic
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from matplotlib.figure import Figure

import levkas
from levkas.simulation import Preset

SMALL = Preset(scale=0.25, thin=True, charts=False, supersampling=1, fineness=2.0)
NM, TARGETS = (470, 550, 630), ("icon1", "dark", "white")

with TemporaryDirectory() as folder:
    list(levkas.simulate_campaign(Path(folder, "icon"), preset=SMALL, cameras=["d80"]))
    raw, truth = Path(folder, "icon", "raw"), Path(folder, "icon", "truth")

    def shots(place):
        return [tifffile.imread(path) for path in sorted((raw / place).glob("*.tif"))]

    mosaic = [shots(f"d80/{target}") for target in TARGETS]
    filtered = [
        np.stack([tifffile.imread(raw / f"lctf-vis/{target}/{nm}nm_00.tif") for nm in NM], -1)
        for target in TARGETS
    ]
    places, known = np.load(truth / "icon1_ref_px.npy"), np.load(truth / "icon1_d80_px.npy")[1:]

# %% Calibrate: reflectance with flags and sigma
reference = levkas.calibrate(*filtered, reflectance=0.98, saturation=4095, wavelengths=NM)
colour = levkas.calibrate(*mosaic, reflectance=0.98, saturation=4095, pattern="RGGB")
print(colour.quantity, colour.labels, f"median sigma {np.median(colour.sigma):.4f}")

# %% Register: a map for every band, its uncertainty, a verdict; beside the truth of the simulation
found = levkas.register(reference.values, colour.values, reference_band="2")
maps = list(found.transforms.values())
errors = [levkas.position_errors(*one) for one in zip(maps, [places] * 3, known, strict=True)]
print(found.verdict.decision, f"mean error {np.mean(errors):.3f} px")

# %% Warp: the colour camera on the pixels of the filter camera, values with flags and variance
shape, more = reference.values.shape[:2], {"flags": colour.flags, "variance": colour.sigma**2}
warped = levkas.warp(colour.values, maps, shape, **more)

# %% Look
figure = Figure((10.5, 2.4), layout="constrained")
shown = reference.values[..., ::-1], colour.values, warped.values, np.sqrt(warped.variance[..., 1])
titles = "filter camera", "colour camera", "colour on filter", "sigma of G"
for axes, picture, title in zip(figure.subplots(1, 4), shown, titles, strict=True):
    drawn = axes.imshow(np.clip(picture, 0, 1) ** (1 / 2.2) if picture.ndim == 3 else picture)
    axes.set(title=title, xticks=[], yticks=[])
drawn.set_clim(0, np.nanpercentile(shown[-1], 99))
figure.colorbar(drawn, ax=figure.axes[3])
figure.savefig(sys.argv[-1] if sys.argv[-1].endswith(".png") else "arrays.png", dpi=90)
