"""The methods that are compared: ours, the paper's, its three opponents, and today's peers."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path


@dataclass(frozen=True)
class ComparedMethod:
    """One row of the comparison.

    Parameters
    ----------
    title : str
        For people.
    module, function : str
        Where it is; of `levkas.registration.METHODS` where `module` is empty.
    package : str
        What must be installed, as it is imported; empty where Levkas has it anyway.
    distribution : str
        Its name for a package manager.
    """

    title: str
    module: str = ""
    function: str = ""
    package: str = ""
    distribution: str = ""

    @property
    def missing(self) -> str:
        """What the method needs and is not there, for a message; empty where it can run."""
        if self.package and find_spec(self.package) is None:
            return f"{self.distribution} is not installed"
        folder = self.module.partition(".")[0]
        if folder and find_spec(folder) is None:
            return f"{folder} is part of the repository alone"
        return ""

    @property
    def version(self) -> str:
        """Version of the package; empty for what is written here."""
        try:
            return version(self.distribution) if self.distribution else ""
        except PackageNotFoundError:
            return ""


_OURS, _PEERS = "levkas.quality.comparison.opencv", "levkas_peers."
COMPARED: dict[str, ComparedMethod] = {
    "levkas": ComparedMethod("Levkas"),
    "mirhashemi2019": ComparedMethod("Mirhashemi 2019"),
    "surf-projective": ComparedMethod(
        "SURF, projective", _PEERS + "surf", "surf_projective", "mahotas", "mahotas"
    ),
    "gdbicp-quadratic": ComparedMethod(
        "GDB-ICP, quadratic", _PEERS + "dual_bootstrap", "gdbicp_quadratic"
    ),
    "gdbicp-radial": ComparedMethod(
        "GDB-ICP, homography and radial", _PEERS + "dual_bootstrap", "gdbicp_radial"
    ),
    "opencv-sift-magsac": ComparedMethod(
        "OpenCV SIFT, MAGSAC", _OURS, "opencv_sift_magsac", "cv2", "opencv-python-headless"
    ),
    "opencv-ecc": ComparedMethod(
        "OpenCV ECC", _OURS, "opencv_ecc", "cv2", "opencv-python-headless"
    ),
    "elastix": ComparedMethod("elastix", _PEERS + "intensities", "elastix", "itk", "itk-elastix"),
    "simpleitk": ComparedMethod(
        "SimpleITK", _PEERS + "intensities", "simpleitk", "SimpleITK", "simpleitk"
    ),
    "ants": ComparedMethod("ANTs SyN", _PEERS + "intensities", "ants", "ants", "antspyx"),
}


def find_peers() -> None:
    """Let `levkas_peers` be imported where this is a checkout: its folder is `benchmarks/peers`."""
    folder = Path(__file__).parents[4] / "benchmarks" / "peers"
    if folder.is_dir() and str(folder) not in sys.path:
        sys.path.append(str(folder))
