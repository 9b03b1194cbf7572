"""What is done with one capture: calibrated, registered, resampled on the grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from math import nan
from typing import TYPE_CHECKING, Any

from levkas.building.fingerprints import keys_of
from levkas.building.native_cubes import require_memory
from levkas.building.progress import Step
from levkas.building.reference import ReferenceFrame, record_of, transforms_of
from levkas.building.registration_stages import RegistrationStages

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from levkas.building.build_records import BuildRecords, Key
    from levkas.building.native_cubes import Native, PackedSigma
    from levkas.building.reference import Grey
    from levkas.building.resample import DefaultLayer, Mosaic
    from levkas.building.rig_mates import RigMates
    from levkas.building.scans import Scan
    from levkas.building.template_cache import TemplateCache
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.catalogue import Entry
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer
    from levkas.database.layout import Places
    from levkas.geometry.grid import Grid


@dataclass
class CaptureStages:
    """The stages of the captures of one object.

    Each takes the stage's key and fingerprints, the capture, a list that holds its calibrated cubes
    between stages, and why it is done.

    Parameters
    ----------
    campaign, places, ledger, shelf
        As of the build.
    name : str
        Of the object.
    captures : list of Capture
        The reference camera's own first.
    write : callable
        Runs what writes a stage's files beside the work, and gives its step.
    being_written : callable
        Gives what is still being written of a capture.
    mates : RigMates
        What is adjusted together.
    """

    campaign: Campaign
    places: Places
    ledger: BuildRecords
    shelf: TemplateCache
    name: str
    captures: list[Capture]
    write: Callable[..., Future[Step]]
    being_written: Callable[[Capture], list[Future[Step]]]
    mates: RigMates
    frame: ReferenceFrame = field(init=False)
    _registering: RegistrationStages = field(init=False)
    _sigmas: dict[str, PackedSigma] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.frame = ReferenceFrame(
            self.campaign, self.places, self.name, self.captures, self.calibrated
        )
        self._registering = RegistrationStages(
            self.campaign,
            self.places,
            self.ledger,
            self.mates,
            self.frame,
            self.calibrated,
            self.being_written,
        )

    def calibrated(self, capture: Capture, native: list[Native | Scan]) -> Native | Scan:
        """The calibrated cubes, from this run or from the database."""
        if not native:
            from levkas.building.native_cubes import read_native
            from levkas.building.scan_opening import open_scan
            from levkas.building.scans import is_streamed

            if is_streamed(capture, self.campaign):
                native.append(open_scan(capture, self.campaign, self.shelf))
                return native[0]
            notes = self.ledger.told(keys_of(capture)["calibrate"])
            native.append(
                read_native(
                    capture,
                    self.places,
                    notes.get("quantity", "counts"),
                    tuple(notes.get("warnings", ())),
                )
            )
        return native[0]

    def calibrate(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Future[Step]:
        from levkas.building.calibrate import develop
        from levkas.building.capture_statistics import focus_of
        from levkas.building.native_cubes import Native, PackedSigma, least_bytes, write_native
        from levkas.building.scan_opening import open_scan
        from levkas.building.scans import is_streamed
        from levkas.building.streaming import write_scan
        from levkas.core.disk import require_space
        from levkas.core.files import together

        streamed = is_streamed(capture, self.campaign)
        if not streamed:
            require_memory(capture, self.campaign.cameras[capture.camera].kind)
        made = (open_scan if streamed else develop)(capture, self.campaign, self.shelf)
        native.append(made.without_sigma())
        if isinstance(made, Native):
            self._sigmas = {
                name: PackedSigma(cube.sigma)
                for name, cube in made.cubes.items()
                if cube.sigma is not None
            }

        def write() -> Step:
            credits = self._credits(made.captured or "")
            centroids = self._centroids(capture)
            with together(partial(self.ledger.forget, key)):
                if isinstance(made, Native):
                    for cube in made.cubes.values():
                        require_space(self.places.output, least_bytes(cube))
                    files = write_native(made, capture, self.places, credits, centroids)
                else:
                    files = write_scan(made, capture, self.places, credits, centroids)
            notes: dict[str, Any] = {
                "quantity": made.quantity,
                "warnings": list(made.warnings),
                "captured": made.captured or "",
                "learnt": dict(made.learnt),
                "focus": focus_of(made) if isinstance(made, Native) else made.focus,
            }
            self.ledger.keep(key, prints, files, **notes)
            return Step(key, "done", why, warnings=made.warnings)

        return self.write(key, capture, write, wait=streamed)

    def register(self, *stage: Any) -> Step:
        """As `RegistrationStages.register`."""
        return self._registering.register(*stage)

    def measure(self, *stage: Any) -> Step:
        """As `RegistrationStages.measure`."""
        return self._registering.measure(*stage)

    def resample(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Future[Step]:
        from levkas.building.capture_statistics import (
            count_flags,
            describe_flags,
            flag_and_count,
            ranges_of,
        )
        from levkas.building.native_cubes import least_bytes, read_sigma
        from levkas.building.resample import resample
        from levkas.building.scans import Scan
        from levkas.core.disk import require_space
        from levkas.core.files import make_folder
        from levkas.database.grey import grey_of
        from levkas.database.layers import Layer, write_layer

        grid, sampling, _ = self.frame.layout(native if capture is self.frame.capture else [])
        here = self.calibrated(capture, native)
        native.clear()
        captured = self.ledger.told(keys_of(capture)["calibrate"]).get("captured", "")
        layer = Layer(
            *(self.name, capture.camera, capture.setup, sampling or nan),
            *(self._credits(captured), self._centroids(capture)),
        )
        decision = record_of(self.places, self.name, capture)["verdict"]["decision"]
        for folder in (self.places.folder(self.name), self.places.store(self.name)):
            make_folder(folder)

        def keep(
            entry: Entry, files: Iterable[Path], grey: Grey, flags: np.ndarray, **more: Any
        ) -> Step:
            notes = {
                **self.frame.similarity(capture, grey),
                "flags": describe_flags(flags),
                "entry": entry.to_row(),
                **more,
            }
            self.ledger.keep(key, prints, files, **notes)
            return Step(key, "done", why)

        if isinstance(here, Scan):
            return self.write(
                key,
                capture,
                partial(self._stream, key, here, capture, layer, decision, grid, keep),
                wait=True,
            )

        def sigma_of(sensor: str) -> np.ndarray | None:
            packed = self._sigmas.pop(sensor, None)
            return packed.unpack() if packed else read_sigma(capture, self.places, sensor)

        mosaics = self._mosaics(capture)
        transforms = transforms_of(self.places, self.name, capture)
        cube = resample(here, transforms, grid, sigma_of, mosaics=mosaics)
        self._sigmas = {}
        encoded = self.campaign.cameras[capture.camera].kind == "image"
        del here
        default = self._default_layer(capture, cube.quantity, cube.values.shape)
        glare = flag_and_count(cube, default.rows() if default else None)

        def write() -> Step:
            require_space(self.places.output, 2 * least_bytes(cube))  # as TIFF and as Zarr
            entry, files = write_layer(
                self.places.output,
                layer,
                cube,
                verdict=decision,
                encoded=encoded,
                before=partial(self.ledger.forget, key),
            )
            ranges = ranges_of(cube.values, cube.flags, cube.sigma, cube.bands)
            grey = grey_of(cube.values, cube.flags)
            return keep(entry, files, grey, count_flags(cube.flags), glare=glare, ranges=ranges)

        return self.write(key, capture, write)

    def _mosaics(self, capture: Capture) -> dict[str, Mosaic]:
        """Sensors of a capture whose values were demosaiced."""
        from levkas.building.calibrate import demosaicing_of
        from levkas.building.resample import Mosaic

        camera = self.campaign.cameras[capture.camera]
        return {
            s.name: Mosaic(s.pattern, demosaicing_of(camera, s.pattern), [b.label for b in s.bands])
            for s in capture.sensors
            if s.pattern is not None and camera.kind in ("mosaic", "sensors")
        }

    def _stream(
        self,
        key: Key,
        scan: Scan,
        capture: Capture,
        layer: Layer,
        decision: str,
        grid: Grid,
        keep: Callable[..., Step],
    ) -> Step:
        """Resample and write a scan some rows at a time."""
        from levkas.building.resample import gains_of_scan
        from levkas.building.streaming import Passing, resample_scan, white_of
        from levkas.database.streaming_writer import write_rows
        from levkas.geometry.transforms import Composed

        transforms = transforms_of(self.places, self.name, capture)
        maps = [Composed(grid.transform, transforms[band.label]) for band in scan.bands]
        shape = (grid.size[1], grid.size[0], len(scan.bands))
        default = self._default_layer(capture, scan.quantity, shape)
        passing = Passing(default, gains_of_scan(default, scan, maps) if default else None)
        made = write_rows(
            self.places.output,
            layer,
            passing.noting(resample_scan(scan, maps, grid.size, spool=self.places.kept)),
            size=grid.size,
            bands=scan.bands,
            quantity=scan.quantity,
            sigma=scan.has_sigma,
            verdict=decision,
            white=white_of(scan),
            before=partial(self.ledger.forget, key),
        )
        more = {"glare": passing.glare, "ranges": passing.ranges(scan.bands)}
        return keep(made.entry, made.files, passing.grey, passing.flags, **more)

    def _default_layer(
        self, capture: Capture, quantity: str, shape: tuple[int, ...]
    ) -> DefaultLayer | None:
        """The same camera's layer under its default lighting, where it was published like this one."""
        default = default_of(capture, self.frame.captures)
        if default is None or quantity != "reflectance":
            return None
        from levkas.building.resample import DefaultLayer

        values, flags = (
            self.places.layer(self.name, capture.camera, kind=k) for k in (".tif", ".flags.tif")
        )
        return DefaultLayer.open(values, flags, (shape[0], shape[1], shape[2]))

    def _centroids(self, capture: Capture) -> dict[str, float]:
        from levkas.building.spectra import broad_centroids

        return broad_centroids(self.campaign, capture.camera, capture.bands)

    def _credits(self, captured: str) -> Credits:
        from levkas.database.credits import Credits

        facts, described = self.campaign.objects.get(self.name), self.campaign.campaign
        return Credits(
            title=(facts.title if facts else "") or self.name,
            creator=described.creator,
            date=captured or described.date or "",
            rights=(facts.rights if facts else "") or described.licence,
        )


def default_of(capture: Capture, captures: list[Capture]) -> Capture | None:
    """Return the same camera's capture under its default setup; None for that itself."""
    if not capture.setup:
        return None
    return next((c for c in captures if c.camera == capture.camera and not c.setup), None)
