"""The five cameras of [mirhashemi2019]_ as models: bands, lenses, sensors, where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from levkas.calibration.noise_model import Sensor
from levkas.campaign.camera_kinds import KINDS
from levkas.colour.illuminants import illuminant
from levkas.simulation.optics import ChromaticOptics, Viewpoint, turn
from levkas.simulation.painting import Panel
from levkas.simulation.pigments import WAVELENGTHS
from levkas.simulation.truth import BandGeometry, CameraGeometry

LARGEST_PANEL = Panel()


@dataclass(frozen=True, eq=False)
class SensorModel:
    """One sensor of a camera: the indices of its bands, their places in its mosaic, its noise."""

    name: str
    bands: tuple[int, ...]
    pattern: tuple[tuple[int, ...], ...] | None = None
    turned_deg: float = 0.0
    shifted: tuple[float, float] = (0.0, 0.0)
    noise: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera; lengths in px are those of full size.

    Parameters
    ----------
    name, kind : str
        As in campaign.toml.
    radial, tangential : tuple of 2 floats
        Of the lens at half the image's width.
    blur : float
        Standard deviation of the optics in focus, px.
    defocus : float
        Growth of the blur at 300 nm from the band in focus, px.
    vignetting : float
        Fall of light in the corner.
    shots, whites, darks : int
        Frames of an object, of the white board, of the dark.
    scan : bool
        A line scanner.
    setup : str
        Key of `lighting.SETUPS`.
    tiles : tuple of int, (rows, columns)
        Frames that show a painting together.
    whole : tuple of int, (width, height), optional
        What tiles show together, px.
    """

    name: str
    kind: str
    width: int
    height: int
    distance_mm: float
    bands: tuple[BandModel, ...]
    sensors: tuple[SensorModel, ...]
    radial: tuple[float, float]
    tangential: tuple[float, float]
    chromatic: ChromaticOptics
    blur: float = 0.45
    defocus: float = 0.25
    vignetting: float = 0.22
    shots: int = 1
    whites: int = 3
    darks: int = 2
    scan: bool = False
    setup: str = "proposed"
    wobble: tuple[float, float, float] = (0.0, 140.0, 0.0)
    tiles: tuple[int, int] = (1, 1)
    whole: tuple[int, int] | None = None

    def tiled(self, rows: int, columns: int, overlap: float) -> CameraModel:
        """Return the camera with a smaller sensor, whose tiles see together what it sees in one frame.

        `overlap` is the share of a tile that its neighbour sees too. A tile has an even number of pixels a side.
        """
        counts, sides = (columns, rows), (self.width, self.height)
        width, height = (
            2 * round(side / (count - (count - 1) * overlap) / 2)
            for side, count in zip(sides, counts, strict=True)
        )
        return replace(self, width=width, height=height, tiles=(rows, columns), whole=sides)

    def step(self, overlap: float) -> tuple[float, float]:
        """Return how far a tile lies from the next, across and down, mm."""
        return tuple((1 - overlap) * n / self.sampling for n in (self.width, self.height))  # type: ignore[return-value]

    def scaled(self, scale: float) -> CameraModel:
        """Return the camera with `scale` times as many pixels a side, seeing the same."""
        width, height = (2 * round(n * scale / 2) for n in (self.width, self.height))

        def shrink(terms: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(v * scale for v in terms)

        c = self.chromatic
        chromatic = replace(
            c, shift_x=shrink(c.shift_x), shift_y=shrink(c.shift_y), smile=shrink(c.smile)
        )
        sensors = tuple(
            replace(s, shifted=(s.shifted[0] * scale, s.shifted[1] * scale)) for s in self.sensors
        )
        amplitude, period, phase = self.wobble
        return replace(
            self,
            width=width,
            height=height,
            chromatic=chromatic,
            sensors=sensors,
            wobble=(amplitude * scale, period, phase),
        )

    @property
    def sampling(self) -> float:
        """Pixels per mm: the largest panel fills five sixths of the image."""
        width, height = self.whole or (self.width, self.height)
        fit = (width / LARGEST_PANEL.width_mm, height / LARGEST_PANEL.height_mm)
        if self.scan:
            turned = (width / LARGEST_PANEL.height_mm, height / LARGEST_PANEL.width_mm)
            fit = max(fit, turned, key=min)
        return 0.83 * min(fit)

    def blur_at(self, wavelength: float) -> float:
        """Return the standard deviation of the optics at a wavelength, px."""
        return float(np.hypot(self.blur, self.defocus * (wavelength - 550.0) / 300.0))

    def geometry(self) -> CameraGeometry:
        """Return what the truth keeps of the camera, free of where it stands."""
        owner = {i: s.name for s in self.sensors for i in s.bands}
        bands = tuple(BandGeometry(b.label, b.centre, owner[i]) for i, b in enumerate(self.bands))
        sensors = {s.name: self.affine(s) for s in self.sensors if len(self.sensors) > 1}
        if len(self.sensors) == 1:
            bands = tuple(replace(b, sensor="") for b in bands)
        return CameraGeometry(self.width, self.height, bands, self.chromatic, sensors)

    def affine(self, sensor: SensorModel) -> np.ndarray:
        """Return pixels of the first sensor → `sensor`, (2, 3): a turn about the middle, a shift."""
        c, s = np.cos(np.radians(sensor.turned_deg)), np.sin(np.radians(sensor.turned_deg))
        linear = np.array([[c, -s], [s, c]])
        middle = np.array([self.width - 1, self.height - 1]) / 2
        return np.column_stack([linear, middle - linear @ middle + sensor.shifted])

    def view(
        self,
        *,
        tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        shift_mm: tuple[float, float] = (0.0, 0.0),
        centre_off: tuple[float, float] = (0.0, 0.0),
    ) -> Viewpoint:
        """Return the camera before a panel: turned about X, Y, Z and moved aside.

        Parameters
        ----------
        tilt_deg : (x, y, roll)
            The camera is turned *about the panel's middle*, which stays in the picture.
        shift_mm : (x, y)
        centre_off : (x, y)
            Principal point from the image's middle, px.
        """
        rotation = turn(*tilt_deg)
        centre = ((self.width - 1) / 2 + centre_off[0], (self.height - 1) / 2 + centre_off[1])
        view = Viewpoint(
            self.width,
            self.height,
            tuple(float(v) for v in rotation.ravel()),
            (shift_mm[0], shift_mm[1], self.distance_mm),
            self.sampling * self.distance_mm,
            centre,
            self.width / 2,
            self.radial,
            self.tangential,
        )
        if not self.scan:
            return view
        # The stage runs across the slit, but for a slight yaw.
        yaw = 0.004
        motion = rotation.T @ np.array([yaw, np.sqrt(1 - yaw**2), 0.0])
        return replace(
            view,
            motion=(float(motion[0]), float(motion[1]), float(motion[2])),
            step_mm=1 / self.sampling,
            wobble=self.wobble,
        )


def relit(camera: CameraModel, illuminant_name: str) -> CameraModel:
    """Return a camera under lamps that filters bring to a CIE illuminant instead of D50.

    The brightest band of each sensor keeps its level, as a new exposure time would make it. Beyond
    830 nm, where CIE's tables end, the ratio of the two is held.
    """
    if illuminant_name == "D50":
        return camera
    known = [illuminant(name) for name in (illuminant_name, "D50")]
    power, d50 = (np.interp(WAVELENGTHS, *table) for table in known if table is not None)
    weighted = [band.response * power / d50 for band in camera.bands]
    levels = [band.level * r.sum() for band, r in zip(camera.bands, weighted, strict=True)]
    for sensor in camera.sensors:
        before = max(camera.bands[i].level for i in sensor.bands)
        scale = before / max(levels[i] for i in sensor.bands)
        for i in sensor.bands:
            levels[i] *= scale
    bands = tuple(
        replace(b, response=r / r.sum(), level=float(v), wavelength=b.centre)
        for b, r, v in zip(camera.bands, weighted, levels, strict=True)
    )
    return replace(camera, bands=bands)


def _tuned(
    name: str, wavelengths: np.ndarray, chromatic: ChromaticOptics, radial: float
) -> CameraModel:
    low, high = wavelengths[0], wavelengths[-1]
    passed = 1 / (1 + np.exp(-(WAVELENGTHS - low - 25) / 25))
    passed = passed / (1 + np.exp((WAVELENGTHS - high - 60) / 40))
    bands = narrow(wavelengths, 12.0, passed, one_exposure=False)
    sensor = SensorModel("", tuple(range(len(bands))), None, noise=_ccd(0.33, dark=22.0))
    return CameraModel(
        name, "bands", 1392, 1040, 1850.0, bands, (sensor,), (radial, 0.0008), (1.5e-4, -1e-4),
        chromatic, whites=3, darks=2,
    )  # fmt: skip


def _ccd(gain: float, *, dark: float) -> Sensor:
    black = 60.0
    return Sensor(dark, 6.0, 0.012, 0.019, gain, black, 12, (4095 - black) / gain * 1.02)


def camera_models(*, thin: bool = False) -> dict[str, CameraModel]:
    """Return the five cameras at full size.

    Parameters
    ----------
    thin : bool
        Every second band of the LCTF-VIS camera and every fifth of LCTF-NIR and V10, two shots,
        two or three templates: a campaign of a tenth of the size.

    Examples
    --------
    >>> {name: len(c.bands) for name, c in camera_models().items()}
    {'d80': 3, 'msbs': 7, 'lctf-vis': 33, 'lctf-nir': 51, 'v10': 121}
    """
    rgb = [bell(600, 34) + 0.12 * bell(540, 30), bell(532, 38), 0.85 * bell(462, 30)]
    d80 = CameraModel(
        "d80", "mosaic", 3900, 2611, 1900.0, broad("R G B", rgb, (3,)),
        (SensorModel("", (0, 1, 2), ((0, 1), (1, 2)), noise=_ccd(0.16, dark=32.0)),),
        (-0.011, 0.0025), (2.5e-4, -2e-4), ChromaticOptics((1.3e-3, 1.8e-3), (0.25,), (-0.2,)),
        blur=0.55, vignetting=0.30, shots=5, whites=10, darks=10,
    )  # fmt: skip
    seven = [
        1.6 * bell(622, 20), 2.4 * bell(548, 17), 1.2 * bell(482, 15),
        2.6 * bell(588, 16), 1.3 * bell(512, 16), 1.0 * bell(440, 17),
        1.5 * silicon() / (1 + np.exp(-(WAVELENGTHS - 745) / 8)),
    ]  # fmt: skip
    bayer = ((0, 1), (1, 2))
    msbs = CameraModel(
        "msbs", "sensors", 1392, 1040, 2200.0, broad("R1 G1 B1 R2 G2 B2 IR", seven, (3, 3, 1)),
        (
            SensorModel("ccd1", (0, 1, 2), bayer, noise=_ccd(0.30, dark=18.0)),
            SensorModel("ccd2", (3, 4, 5), bayer, 0.012, (7.6, -5.2), _ccd(0.30, dark=20.0)),
            SensorModel("ccd3", (6,), None, -0.075, (-6.3, -14.8), _ccd(0.30, dark=15.0)),
        ),
        (0.005, -0.001), (-1e-4, 2e-4), ChromaticOptics((-4e-4, 1.1e-3), (0.1,), (0.1,)),
        shots=5, whites=10, darks=10,
    )  # fmt: skip
    v10_bands = np.arange(400.0, 1001.0, 5.0)
    spectrograph = narrow(v10_bands, 7.0, 0.25 + 0.75 * bell(620, 170), one_exposure=True)
    v10 = CameraModel(
        "v10", "cube", 1100, 850, 1200.0, spectrograph,
        (SensorModel("", tuple(range(121)), None, noise=_ccd(0.25, dark=25.0)),),
        (-0.003, 0.0004), (0.0, 1e-4),
        ChromaticOptics((3e-4, 6e-4), (0.15,), (0.1, 0.1), (0.25,)),
        whites=64, darks=64, scan=True, setup="scan", wobble=(0.18, 150.0, 0.8), defocus=0.2,
    )  # fmt: skip
    vis = _tuned("lctf-vis", np.arange(400.0, 721.0, 10.0), ChromaticOptics((-6e-4, 1.0e-3), (0.2,), (0.15, 0.1)), -0.004)  # fmt: skip
    nir = _tuned("lctf-nir", np.arange(450.0, 951.0, 10.0), ChromaticOptics((5e-4, 7e-4), (-0.2,), (0.2,)), -0.0032)  # fmt: skip
    models = {c.name: c for c in (d80, msbs, vis, nir, v10)}
    return {name: _thinned(c) if thin else c for name, c in models.items()}


def _thinned(camera: CameraModel) -> CameraModel:
    if not KINDS[camera.kind].is_broad:
        every = 2 if camera.name == "lctf-vis" else 5
        # 550 nm, the reference, must stay.
        first = next(i for i, b in enumerate(camera.bands) if b.label == "550 nm") % every
        bands = camera.bands[first::every]
        sensor = replace(camera.sensors[0], bands=tuple(range(len(bands))))
        many = KINDS[camera.kind].is_scanned
        return replace(
            camera,
            bands=bands,
            sensors=(sensor,),
            whites=32 if many else 1,
            darks=32 if many else 1,
        )
    return replace(camera, shots=2, whites=3, darks=3)


PEAK = 0.85


@dataclass(frozen=True, eq=False)
class BandModel:
    """One channel.

    Parameters
    ----------
    response : ndarray, (n,)
        Light times sensitivity at `pigments.WAVELENGTHS`, of sum 1.
    level : float
        Where the brightest white lies, as a share of the sensor's range.
    wavelength : float
        Nominal, nm; the centroid of the response if left out.
    """

    label: str
    response: np.ndarray
    level: float
    wavelength: float = float("nan")

    @property
    def centre(self) -> float:
        """Wavelength at which the lens acts, nm."""
        if np.isfinite(self.wavelength):
            return self.wavelength
        return float(WAVELENGTHS @ self.response)


def bell(centre: float, width: float) -> np.ndarray:
    """Return a Gaussian of peak 1 at `pigments.WAVELENGTHS`; width one standard deviation, nm."""
    return np.exp(-0.5 * ((WAVELENGTHS - centre) / width) ** 2)


def _lamp_light() -> np.ndarray:
    """Halogen behind a D50 simulator: flat, falling into the near infrared."""
    return (0.35 + 0.65 / (1 + np.exp(-(WAVELENGTHS - 430) / 22))) * (
        0.30 + 0.70 / (1 + np.exp((WAVELENGTHS - 780) / 55))
    )


def silicon() -> np.ndarray:
    """Return the quantum efficiency of a CCD."""
    return (0.25 + 0.75 * bell(560, 130)) / (1 + np.exp((WAVELENGTHS - 935) / 40))


def _responses(sensitivities: list[np.ndarray], light: np.ndarray) -> list[np.ndarray]:
    return [s * light / (s * light).sum() for s in sensitivities]


def broad(labels: str, shapes: list[np.ndarray], groups: tuple[int, ...]) -> tuple[BandModel, ...]:
    """Return broad bands, the brightest of each sensor exposed to the peak."""
    light = _lamp_light()
    totals = np.array([(s * light).sum() for s in shapes])
    levels = np.concatenate(
        [PEAK * part / part.max() for part in np.split(totals, np.cumsum(groups)[:-1])]
    )
    return tuple(
        BandModel(*b) for b in zip(labels.split(), _responses(shapes, light), levels, strict=True)
    )


def narrow(
    wavelengths: np.ndarray, fwhm: float, transmission: np.ndarray, *, one_exposure: bool
) -> tuple[BandModel, ...]:
    """Return bands of a filter or a spectrograph; an own exposure each, up to six-fold, or one."""
    power = _lamp_light() * silicon() * transmission
    shapes = [bell(w, fwhm / 2.355) for w in wavelengths]
    totals = np.array([(s * power).sum() for s in shapes])
    share = totals / totals.max()
    levels = PEAK * (share if one_exposure else np.minimum(1.0, 6 * share))
    return tuple(
        BandModel(f"{w:g} nm", r, float(v), float(w))
        for w, r, v in zip(wavelengths, _responses(shapes, power), levels, strict=True)
    )


def response_table(bands: Sequence[BandModel]) -> tuple[list[str], np.ndarray]:
    """Return the labels and sensitivities, (wavelengths, bands), each with a peak of 1.

    The light is divided out of what `BandModel.response` holds.
    """
    shapes = np.stack([b.response / _lamp_light() for b in bands], 1)
    return [b.label for b in bands], shapes / shapes.max(0)
