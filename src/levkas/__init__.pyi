"""What checkers of types see: the names that `__init__.py` loads when they are first used."""

from levkas.building import build as build
from levkas.building import status as status
from levkas.calibration.noise_model import Sensor as Sensor
from levkas.calibration.noise_model import noise_variance as noise_variance
from levkas.calibration.reflectance import calibrate as calibrate
from levkas.campaign.campaign import load_campaign as load_campaign
from levkas.campaign.discovery.find_captures import find_captures as find_captures
from levkas.core.cube import Band as Band
from levkas.core.cube import Cube as Cube
from levkas.core.cube import Flag as Flag
from levkas.core.instructions import hold_instructions as hold_instructions
from levkas.core.problems import Problem as Problem
from levkas.core.problems import Refused as Refused
from levkas.database import open as open
from levkas.database.pixel_frames import map_points as map_points
from levkas.database.spectral_tiff import read_mtiff as read_mtiff
from levkas.database.spectral_tiff import read_stiff as read_stiff
from levkas.database.spectral_tiff import write_stiff as write_stiff
from levkas.estimation.experiment import estimate as estimate
from levkas.geometry.grid import Grid as Grid
from levkas.geometry.resample import warp as warp
from levkas.geometry.transforms import Affine as Affine
from levkas.geometry.transforms import Composed as Composed
from levkas.geometry.transforms import Homography as Homography
from levkas.geometry.transforms import Inverse as Inverse
from levkas.geometry.transforms import Lens as Lens
from levkas.geometry.transforms import Polynomial as Polynomial
from levkas.quality.evaluation.layer_report import assess as assess
from levkas.quality.evaluation.similarity import position_errors as position_errors
from levkas.quality.evaluation.similarity import structural_similarity as structural_similarity
from levkas.readers.spectral_library import read_spectra as read_spectra
from levkas.readers.spectral_library import write_spectra as write_spectra
from levkas.registration import register as register
from levkas.simulation import simulate_campaign as simulate_campaign

__version__: str
