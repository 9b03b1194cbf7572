"""The stages of one object: calibrate, register, resample, report."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from math import nan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.building import fingerprints
from levkas.building.fingerprints import digest
from levkas.building.fitting import ran_out, require_memory
from levkas.building.ledger import Key, Ledger
from levkas.building.standing import Standing, is_of_the_disk
from levkas.building.steps import Step
from levkas.machine import give_back_memory, steady_libraries
from levkas.problems import Problem, Refused

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.building.default_setup import DefaultLayer
    from levkas.building.native import Native, PackedSigma
    from levkas.building.places import Places
    from levkas.building.scans import Scan
    from levkas.building.shelf import Shelf
    from levkas.campaign import Campaign
    from levkas.database.catalogue import Entry
    from levkas.database.credits import Credits
    from levkas.database.layers import Layer
    from levkas.discovery import Capture
    from levkas.gridding import Grid
    from levkas.registration import BandImage, Registration
    from levkas.registration.levkas import Reference

    Grey = tuple[np.ndarray, np.ndarray]

STAGES = ("calibrate", "register", "resample")
CATALOGUE = Key("", stage="catalogue")


class Planned(NamedTuple):
    """A stage of a capture, what it hangs on, and why it must be done; empty where it need not."""

    key: Key
    prints: dict[str, Any]
    why: str


@dataclass
class ObjectBuild:
    """What the stages of one object share while they run.

    Parameters
    ----------
    captures : list of Capture
        The reference camera's own first.
    """

    campaign: Campaign
    places: Places
    ledger: Ledger
    shelf: Shelf
    name: str
    captures: list[Capture]
    digests: dict[Key, str] = field(default_factory=dict)
    _images: list[BandImage] | None = None
    _own: Registration | None = None
    _ready: Reference | None = None
    _grid: tuple[Grid, float | None, tuple[float, float, float, float] | None] | None = None
    _grey: tuple[np.ndarray, np.ndarray] | None = None
    _sigmas: dict[str, PackedSigma] = field(default_factory=dict)
    _hashing: bool = False
    _checked: bool = False
    _standing: Standing = field(init=False)
    _being_written: list[tuple[Capture, Future[Step]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._standing = Standing(self.ledger)

    @property
    def reference(self) -> Capture:
        """The capture that all others are registered to."""
        return self.captures[0]

    def run(self) -> Iterator[Step]:
        """Yield every stage as it begins and as it ends.

        What a stage made is compressed and written while the next one computes.
        """
        with (
            ThreadPoolExecutor(1, thread_name_prefix="writing") as self._writer,
            ThreadPoolExecutor(1, thread_name_prefix="hashing") as self._hasher,
        ):
            try:
                yield from self._all()
            finally:
                self._hasher.shutdown(wait=False, cancel_futures=True)

    def _all(self) -> Iterator[Step]:
        broken: Refused | None = None
        for capture in self._largest_first():
            if broken is not None and capture is not self.reference:
                yield _refused(self.keys(capture)["calibrate"], broken)
                continue
            failed = None
            plan = self._plan(capture)
            due = any(planned.why for planned in plan.values())
            if due and not self._checked and capture is not self.reference:
                yield from self._check_reference()
            self._checked = self._checked or due
            for step in self._capture(capture, plan):
                yield step
                failed = step if step.state in ("refused", "failed") else failed
            if failed is not None and capture is self.reference:
                broken = NoReference(_no_reference(self.name, capture.layer, failed))
        yield from self._written()

    def _largest_first(self) -> list[Capture]:
        """The reference, then the others, most bands first: little is left to write at the end."""
        return [self.reference, *sorted(self.captures[1:], key=lambda c: -len(c.bands))]

    def _hash_ahead(self) -> None:
        """Hash the frames of all captures beside the work; what fails is met again when it is due."""
        if not self._hashing:
            self._hashing = True
            for capture in self._largest_first():
                self._hasher.submit(
                    fingerprints.of_calibration, self.campaign, capture, self.ledger.hashes
                )

    def states(self) -> list[Step]:
        """Say of every stage whether it is fresh or stale, and why, without doing any."""
        steps = []
        for capture in self.captures:
            for stage, key in self.keys(capture).items():
                prints = self._prints(capture, stage)
                self.digests[key] = digest(prints)
                why = self.ledger.why_stale(key, prints)
                step = Step(key, "stale", why) if why else self._fresh(key)
                steps.append(step)
                if step.state == "refused":
                    break
        return steps

    def keys(self, capture: Capture) -> dict[str, Key]:
        """Return the keys of a capture's stages."""
        return fingerprints.keys_of(capture)

    # --- one capture --------------------------------------------------------------------------

    def _plan(self, capture: Capture, *, verify: bool = False) -> dict[str, Planned]:
        """Say what each stage of a capture hangs on, and why it must be done.

        What a stage made is read in full and checked before a later one that is due reads it.
        """
        plan: dict[str, Planned] = {}
        for stage, key in self.keys(capture).items():
            prints = self._prints(capture, stage)
            self.digests[key] = digest(prints)
            plan[stage] = Planned(key, prints, self.ledger.why_stale(key, prints))
        due = [stage for stage, planned in plan.items() if planned.why]
        if due or verify:
            for one in (self.reference, capture):
                self._standing.note(self.keys(one).values())
        for stage, planned in plan.items():
            read = verify or (due and STAGES.index(stage) < STAGES.index(due[-1]))
            if read and not planned.why and (name := self.ledger.damaged(planned.key)):
                plan[stage] = planned._replace(why=f"{name} was damaged")
        return plan

    def _check_reference(self) -> Iterator[Step]:
        """Before another capture reads what was kept of the reference, mend what is damaged of it."""
        self._checked = True
        for step in self._capture(self.reference, self._plan(self.reference, verify=True)):
            if step.state != "fresh":
                yield step

    def _capture(self, capture: Capture, plan: dict[str, Planned]) -> Iterator[Step]:
        native: list[Native | Scan] = []
        for stage, (key, prints, why) in plan.items():
            if stage == "register":
                # Two cubes at once are enough; the one of the capture before goes first.
                yield from self._written(but=capture)
            if why:
                self._hash_ahead()
                yield Step(key, "running", why)
            ended = self._attempt(stage, key, prints, capture, native, why) if why else None
            if isinstance(ended, Future):
                self._being_written.append((capture, ended))
                if stage == "calibrate" or capture is not self.reference:
                    continue
            failed = False
            for step in self._written(of=capture):
                yield step
                failed = failed or step.state == "refused"
            if failed or isinstance(ended, Future):
                return
            step = ended or self._fresh(key)
            if step.state in ("refused", "failed"):
                yield self._lost(capture, step)
                return
            yield step

    def _written(self, *, of: Capture | None = None, but: Capture | None = None) -> Iterator[Step]:
        """Wait for what is being written, and yield how those stages ended."""
        for waiting in list(self._being_written):
            capture, job = waiting
            if (of is not None and capture is not of) or capture is but:
                continue
            self._being_written.remove(waiting)
            step = job.result()
            yield self._lost(capture, step) if step.state == "refused" else step

    def _prints(self, capture: Capture, stage: str) -> dict[str, Any]:
        if stage == "calibrate":
            return fingerprints.of_calibration(self.campaign, capture, self.ledger.hashes)
        keys, base = self.keys(capture), self.keys(self.reference)
        if stage == "register":
            ends = self.digests[keys["calibrate"]], self.digests[base["calibrate"]]
            return fingerprints.of_registration(self.campaign, capture, *ends)
        ends = self.digests[keys["register"]], self.digests[base["register"]]
        default = self._default_of(capture)
        other = "" if default is None else self.digests[self.keys(default)["resample"]]
        return fingerprints.of_resampling(self.campaign, capture, *ends, default=other)

    def _fresh(self, key: Key) -> Step:
        notes = self.ledger.told(key)
        warnings = tuple(notes.get("warnings", ()))
        problems = tuple(Problem(**p) for p in notes.get("refused", ()))
        if problems:
            return Step(key, "refused", problems[0].message, problems=problems, warnings=warnings)
        return Step(key, "fresh", warnings=warnings)

    def _attempt(
        self,
        stage: str,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Step | Future[Step]:
        """Do a stage; what it makes may still be being written when this returns."""
        self.ledger.forget(CATALOGUE)  # what it lists is about to change
        stages: dict[str, Callable[..., Step | Future[Step]]] = {
            "calibrate": self._calibrate,
            "register": self._register,
            "resample": self._resample,
        }
        give_back_memory()
        try:
            with steady_libraries():
                return stages[stage](key, prints, capture, native, why)
        except Refused as refused:
            return self._failed(key, refused)
        except MemoryError as error:
            return self._failed(key, ran_out(capture, error))

    def _failed(self, key: Key, refused: Refused) -> Step:
        """Return the step of a refused stage; what it made before stays where only the disk refused."""
        if not is_of_the_disk(refused.problems):
            self.ledger.forget(key)
        return _refused(key, refused)

    def _write(
        self, key: Key, capture: Capture, write: Callable[[], Step], *, wait: bool = False
    ) -> Future[Step]:
        def attempt() -> Step:
            try:
                return write()
            except Refused as refused:
                return self._failed(key, refused)
            except MemoryError as error:
                return self._failed(key, ran_out(capture, error))

        job = self._writer.submit(attempt)
        if wait:
            job.exception()
        return job

    def _native(self, capture: Capture, native: list[Native | Scan]) -> Native | Scan:
        """The calibrated cubes, from this run or from the database."""
        if not native:
            from levkas.building.native import read_native
            from levkas.building.scans import is_streamed, open_scan

            if is_streamed(capture, self.campaign):
                native.append(open_scan(capture, self.campaign, self.shelf))
                return native[0]
            notes = self.ledger.told(self.keys(capture)["calibrate"])
            native.append(
                read_native(
                    capture,
                    self.places,
                    notes.get("quantity", "counts"),
                    tuple(notes.get("warnings", ())),
                )
            )
        return native[0]

    def _calibrate(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Future[Step]:
        from levkas.building.developing import develop
        from levkas.building.focusing import focus_of
        from levkas.building.native import Native, PackedSigma, least_bytes, write_native
        from levkas.building.scans import is_streamed, open_scan
        from levkas.building.streaming import write_scan
        from levkas.disk import require_space
        from levkas.files import together

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
            with together(partial(self.ledger.forget, key)):
                if isinstance(made, Native):
                    for cube in made.cubes.values():
                        require_space(self.places.output, least_bytes(cube))
                    files = write_native(made, capture, self.places, credits)
                else:
                    files = write_scan(made, capture, self.places, credits)
            notes = {
                "quantity": made.quantity,
                "warnings": list(made.warnings),
                "captured": made.captured or "",
                "learnt": dict(made.learnt),
                "focus": focus_of(made) if isinstance(made, Native) else made.focus,
            }
            self.ledger.keep(key, prints, files, **notes)
            return Step(key, "done", why, warnings=made.warnings)

        return self._write(key, capture, write, wait=streamed)

    def _register(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Step:
        from levkas.building import registering
        from levkas.files import make_folder, remove, together, write_json, write_text
        from levkas.registration import RegistrationRefused
        from levkas.reporting.figures import draw_trace

        started = time.monotonic()
        here = self._native(capture, native)
        options = dict(self.campaign.registration_of(capture.camera))
        given, by_hand = registering.corrections_of(self.campaign, capture)
        options |= by_hand
        own = None if capture is self.reference else self._own_registration()
        registration, refused = None, None
        grid, sampling, region = self._frame(native if capture is self.reference else [])
        if options.get("method", "levkas") == "levkas":
            options["ready"] = partial(self._ready_reference, native, region, own)
        try:
            registration = registering.register_capture(
                here,
                self._reference_images(native if own is None else []),
                self._reference_band(),
                own,
                region,
                options,
                given,
            )
        except RegistrationRefused as error:
            refused = error
        if capture is self.reference and registration is not None:
            self._own = registration
            self._settle()
        if self._ready is not None:
            self._ready.rest()
        if registration is not None:
            width, height = self._reference_record()["size"]
            across, down = here.size_of(here.bands[0].label)
            trace = registering.trace_of(registration, (width, height), (across, down), options)
            registration = replace(registration, trace=trace)
        record = registering.record_of(
            registration,
            refused,
            capture,
            here,
            grid,
            self._reference_record(),
            sampling,
            self._channel(capture),
            options.get("method", "levkas"),
        )
        path, table = (
            self.places.registration(self.name, capture.layer),
            self.places.matches(self.name, capture.layer),
        )
        for waiting, job in self._being_written:
            # A registration of frames that could not be written would stand beside older ones.
            if waiting is capture and (calibrated := job.result()).state == "refused":
                return calibrated
        make_folder(path.parent)
        with together(partial(self.ledger.forget, key)):
            write_json(path, record)
            files = [path]
            tables = {}
            if registration is not None:
                tables = {table: registration.matches} | {
                    self.places.matches(self.name, capture.layer, sensor): matches
                    for sensor, matches in registration.others.items()
                }
            for place, matches in tables.items():
                write_text(place, registering.table_of(matches))
                files.append(place)
            names = [self.places.matches(self.name, capture.layer, s.name) for s in capture.sensors]
            for place in sorted({table, *names} - tables.keys()):
                if place.is_file():
                    remove(place)
        problems = _verdict_problems(record, capture, refused)
        figures = []
        if registration is not None:
            figures = draw_trace(registration.matches, registration.trace)
        notes = {
            "seconds": round(time.monotonic() - started, 2),
            "refused": [p.to_dict() for p in problems],
            "figures": [[f.svg, f.caption] for f in figures],
        }
        self.ledger.keep(key, prints, files, **notes)
        if problems:
            return Step(key, "refused", problems[0].message, problems=problems)
        verdict = record["verdict"]
        warned = (
            ()
            if verdict["decision"] != "warn"
            else (f"{self.name}/{capture.layer}: {' '.join(verdict['reasons'])}",)
        )
        return Step(key, "done", why, warnings=warned)

    def _resample(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Future[Step]:
        from levkas.building.measuring import flag_and_count, ranges_of
        from levkas.building.native import least_bytes, read_sigma
        from levkas.building.resampling import count_flags, describe_flags, grey_of, resample
        from levkas.building.scans import Scan
        from levkas.database.layers import Layer, write_layer
        from levkas.disk import require_space
        from levkas.files import make_folder

        grid, sampling, _ = self._frame(native if capture is self.reference else [])
        here = self._native(capture, native)
        native.clear()
        captured = self.ledger.told(self.keys(capture)["calibrate"]).get("captured", "")
        layer = Layer(
            self.name, capture.camera, capture.setup, sampling or nan, self._credits(captured)
        )
        decision = self._record(capture)["verdict"]["decision"]
        for folder in (self.places.folder(self.name), self.places.store(self.name)):
            make_folder(folder)

        def keep(
            entry: Entry, files: Iterable[Path], grey: Grey, flags: np.ndarray, **more: Any
        ) -> Step:
            notes = {
                **self._similarity(capture, grey),
                "flags": describe_flags(flags),
                "entry": entry.to_row(),
                **more,
            }
            self.ledger.keep(key, prints, files, **notes)
            return Step(key, "done", why)

        if isinstance(here, Scan):
            return self._write(
                key,
                capture,
                partial(self._stream, key, here, capture, layer, decision, grid, keep),
                wait=True,
            )

        def sigma_of(sensor: str) -> np.ndarray | None:
            packed = self._sigmas.pop(sensor, None)
            return packed.unpack() if packed else read_sigma(capture, self.places, sensor)

        cube = resample(here, self._transforms(capture), grid, sigma_of)
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

        return self._write(key, capture, write)

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
        from levkas.building.default_setup import gains_of_scan
        from levkas.building.streaming import Passing, resample_scan, white_of
        from levkas.database.spooling import write_rows
        from levkas.transforms import Composed

        transforms = self._transforms(capture)
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
        default = self._default_of(capture)
        if default is None or quantity != "reflectance":
            return None
        from levkas.building.default_setup import DefaultLayer

        values, flags = (
            self.places.layer(self.name, capture.camera, kind=k) for k in (".tif", ".flags.tif")
        )
        return DefaultLayer.open(values, flags, (shape[0], shape[1], shape[2]))

    def _default_of(self, capture: Capture) -> Capture | None:
        """The same camera's capture under its default setup, None for that itself."""
        if not capture.setup:
            return None
        mine = (c for c in self.captures if c.camera == capture.camera and not c.setup)
        return next(mine, None)

    def _lost(self, capture: Capture, step: Step) -> Step:
        """Withdraw a layer whose stage was refused, or say that the older one stays.

        It stays where only the disk refused, and where nothing of this build stands beside it yet.
        """
        keys = [key for c in (self.reference, capture) for key in self.keys(c).values()]
        if is_of_the_disk(step.problems):
            if self._standing.holds(keys):
                told = f"{self.name}/{capture.layer}: the layer of an earlier build stays"
                return replace(step, warnings=(*step.warnings, told))
            self.ledger.forget(step.key)
        self._withdraw(capture)
        return step

    def _withdraw(self, capture: Capture) -> None:
        """Take away what an earlier build published of a layer that is refused now."""
        from levkas.files import remove

        # By name, not by record: an interrupted build has dropped the record and left the files.
        self.ledger.forget(CATALOGUE)
        self.ledger.forget(self.keys(capture)["resample"])
        places = [
            self.places.layer(self.name, capture.camera, capture.setup, kind=kind)
            for kind in (".tif", ".flags.tif", ".sigma.tif", ".png")
        ]
        for path in (*places, self.places.store(self.name) / capture.layer):
            if path.exists():
                remove(path)

    # --- what stages share --------------------------------------------------------------------

    def _reference_band(self) -> str:
        from levkas.cube import find_band

        bands = self.reference.bands
        wanted = self.campaign.reference.band
        labels = [band.label for band in bands]
        if wanted is None:
            return labels[len(labels) // 2]
        return labels[find_band(labels, wanted, [band.wavelength for band in bands])]

    def _reference_images(self, native: list[Native | Scan]) -> list[BandImage]:
        if self._images is None:
            self._images = self._native(self.reference, native).images()
        return self._images

    def _ready_reference(
        self,
        native: list[Native | Scan],
        region: tuple[float, float, float, float] | None,
        own: Registration | None,
    ) -> Reference:
        """The reference made ready for all captures; its single bands go once it is registered."""
        from levkas.registration.levkas import Reference

        if self._ready is None:
            images = self._reference_images(native if own is None else [])
            self._ready = Reference(images, self._reference_band(), region)
            if own is not None:
                self._settle()
        return self._ready

    def _settle(self) -> None:
        methods = {self.campaign.registration_of(c.camera).get("method") for c in self.captures}
        if self._ready is not None and methods <= {None, "levkas"}:
            self._ready.settle(self._own_registration().transforms)
            # Bands share their memory with others that are not needed any more.
            anchor = self._ready.anchor
            self._ready.anchor = replace(
                anchor, values=anchor.values.copy(), valid=anchor.valid.copy()
            )
            self._ready.siblings, self._images = [], [self._ready.anchor]

    def _own_registration(self) -> Registration:
        """The reference camera's own registration, from this run or from its record."""
        if self._own is None:
            from levkas.registration import Matches, Registration, Verdict
            from levkas.registration.uncertainty import Sigma

            bands = self._record(self.reference)["bands"]
            self._own = Registration(
                "",
                self._transforms(self.reference),
                Verdict("accept"),
                {},
                Matches.of(np.zeros((0, 2)), np.zeros((0, 2))),
                sigma={
                    label: Sigma.from_dict(band["sigma"])
                    for label, band in bands.items()
                    if "sigma" in band
                },
            )
        return self._own

    def _record(self, capture: Capture) -> dict[str, Any]:
        import json

        path = self.places.registration(self.name, capture.layer)
        return dict(json.loads(path.read_text(encoding="utf-8")))

    def _transforms(self, capture: Capture) -> dict[str, Any]:
        from levkas.transforms import from_dict

        bands = self._record(capture)["bands"]
        return {label: from_dict(band["transform"]) for label, band in bands.items()}

    def _reference_record(self) -> dict[str, Any]:
        image = next(i for i in self._reference_images([]) if i.label == self._reference_band())
        return {"camera": self.reference.camera, "band": image.label, "size": list(image.size)}

    def _frame(
        self, native: list[Native | Scan]
    ) -> tuple[Grid, float | None, tuple[float, float, float, float] | None]:
        """The grid, its sampling in px per mm where known, and the object's region in reference px."""
        if self._grid is None:
            from levkas.building.framing import frame_object

            image = next(
                i for i in self._reference_images(native) if i.label == self._reference_band()
            )
            facts = self.campaign.objects.get(self.name)
            self._grid = frame_object(image, self.campaign.grid, facts.size_mm if facts else None)
        return self._grid

    def _channel(self, capture: Capture) -> str:
        from levkas.building.channels import reference_channel

        wanted = next(b for b in self.reference.bands if b.label == self._reference_band())
        return reference_channel(self.campaign, capture.camera, capture.bands, wanted.wavelength)

    def _credits(self, captured: str) -> Credits:
        from levkas.database.credits import Credits

        facts, described = self.campaign.objects.get(self.name), self.campaign.campaign
        return Credits(
            title=(facts.title if facts else "") or self.name,
            creator=described.creator,
            date=captured or described.date or "",
            rights=(facts.rights if facts else "") or described.licence,
        )

    def _similarity(self, capture: Capture, grey: Grey) -> dict[str, Any]:
        """SSIM against the reference layer, and its map as PNG text, for the report."""
        from levkas.building.resampling import read_grey, shrink_map
        from levkas.database.preview import encode_png
        from levkas.evaluation import structural_similarity

        if capture is self.reference:
            self._grey = grey
            return {"ssim": None, "ssim_map": ""}
        if self._grey is None:
            self._grey = read_grey(self.places.layer(self.name, self.reference.camera))
        score, full = structural_similarity(self._grey[0], grey[0], self._grey[1] & grey[1])
        if np.isnan(score):
            return {"ssim": None, "ssim_map": ""}
        return {
            "ssim": score,
            "ssim_map": base64.b64encode(encode_png(shrink_map(full))).decode("ascii"),
        }


class NoReference(Refused):
    """Nothing can be registered to a reference that is not there."""


def _no_reference(name: str, layer: str, failed: Step) -> Problem:
    return Problem(
        "E_NO_REFERENCE",
        f"{name}: the reference camera could not be built, so nothing can be registered to it",
        field="campaign.reference",
        found=f"{layer}: {failed.why}",
        fix="Mend the reference camera's frames first.",
    )


def _refused(key: Key, refused: Refused) -> Step:
    why = refused.problems[0].message if refused.problems else str(refused)
    return Step(key, "refused", why, problems=tuple(refused.problems))


def _verdict_problems(
    record: dict[str, Any], capture: Capture, refused: Refused | None
) -> tuple[Problem, ...]:
    """The problems of a registration that is refused; none for one that is accepted."""
    if refused is not None:
        return tuple(refused.problems)
    verdict = record["verdict"]
    if verdict["decision"] != "refuse":
        return ()
    reasons = " ".join(verdict["reasons"])
    return (
        Problem(
            "E_VERDICT",
            f"{capture.object}/{capture.layer}: the registration cannot be believed: {reasons}",
            field=f"cameras.{capture.camera}.registration",
            fix=verdict["next_step"] or None,
        ),
    )
