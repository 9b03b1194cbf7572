"""The methods that are compared: ours, the paper's, its three opponents, and today's peers."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec


@dataclass(frozen=True)
class Method:
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
    def missing(self) -> bool:
        """True where the package that the method needs is not installed."""
        return bool(self.package) and find_spec(self.package) is None

    @property
    def version(self) -> str:
        """Version of the package; empty for what is written here."""
        try:
            return version(self.distribution) if self.distribution else ""
        except PackageNotFoundError:
            return ""


_HERE = "levkas.quality.comparison."
COMPARED: dict[str, Method] = {
    "levkas": Method("Levkas"),
    "mirhashemi2019": Method("Mirhashemi 2019"),
    "surf-projective": Method(
        "SURF, projective", _HERE + "features", "surf_projective", "mahotas", "mahotas"
    ),
    "gdbicp-quadratic": Method(
        "GDB-ICP, quadratic", _HERE + "dual_bootstrap", "gdbicp_quadratic"
    ),
    "gdbicp-radial": Method(
        "GDB-ICP, homography and radial", _HERE + "dual_bootstrap", "gdbicp_radial"
    ),
    "opencv-sift-magsac": Method(
        "OpenCV SIFT, MAGSAC", _HERE + "features", "opencv_sift_magsac", "cv2",
        "opencv-python-headless",
    ),
    "opencv-ecc": Method(
        "OpenCV ECC", _HERE + "intensities", "opencv_ecc", "cv2", "opencv-python-headless"
    ),
    "elastix": Method("elastix", _HERE + "intensities", "elastix", "itk", "itk-elastix"),
    "simpleitk": Method("SimpleITK", _HERE + "intensities", "simpleitk", "SimpleITK", "simpleitk"),
    "ants": Method("ANTs SyN", _HERE + "intensities", "ants", "ants", "antspyx"),
}  # fmt: skip
