"""How a capture is registered: by itself, and adjusted with others by the same camera."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from levkas.building.progress import Step
from levkas.campaign.methods import DEFAULT_METHOD
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from levkas.building.build_records import BuildRecords, Key
    from levkas.building.native_cubes import Native
    from levkas.building.reference import ReferenceFrame
    from levkas.building.register import Measured
    from levkas.building.rig_mates import RigMates
    from levkas.building.scans import Scan
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places


@dataclass
class RegistrationStages:
    """The stages between calibrated cubes and maps.

    Parameters
    ----------
    campaign, places, ledger, mates
        As of the build.
    frame : ReferenceFrame
        Of the object.
    calibrated : callable
        Gives the calibrated cubes of a capture.
    being_written : callable
        Gives what is still being written of a capture.
    """

    campaign: Campaign
    places: Places
    ledger: BuildRecords
    mates: RigMates
    frame: ReferenceFrame
    calibrated: Callable[[Capture, list[Native | Scan]], Native | Scan]
    being_written: Callable[[Capture], list[Future[Step]]]

    def register(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Step:
        """Register a capture and publish its record, adjusted where that is asked for."""
        started = time.monotonic()
        if self.campaign.is_joint(capture.camera):
            measured = self._adjusted(capture)
            figures = _drawn(measured.record)
        else:
            measured, figures = self._measured(capture, native)
        # A registration of frames that could not be written would stand beside older ones.
        if (stopped := self._unwritten(capture)) is not None:
            return stopped
        return self._publish(key, prints, capture, why, measured, figures, started)

    def measure(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        native: list[Native | Scan],
        why: str,
    ) -> Step:
        """Register a capture by itself and keep what its camera saw for the others."""
        started = time.monotonic()
        measured, figures = self._measured(capture, native)
        if (stopped := self._unwritten(capture)) is not None:
            return stopped
        # What was kept before stays until this stands in its place: the record knows its hash.
        path = self.mates.keep(capture, measured)
        seconds = round(time.monotonic() - started, 2)
        self.ledger.keep(key, prints, [], aside=[path], seconds=seconds, figures=figures)
        return Step(key, "done", why)

    def _measured(
        self, capture: Capture, native: list[Native | Scan]
    ) -> tuple[Measured, list[list[str]]]:
        from levkas.building.register import (
            Measured,
            corrections_of,
            record_of,
            register_capture,
        )
        from levkas.pages.figures import draw_trace
        from levkas.registration import RegistrationRefused

        here = self.calibrated(capture, native)
        options = dict(self.campaign.registration_of(capture.camera))
        given, by_hand = corrections_of(self.campaign, capture, self.frame.channel(capture))
        options |= by_hand
        own = None if capture is self.frame.capture else self.frame.registration()
        registration, refused = None, None
        grid, sampling, region = self.frame.layout(native if capture is self.frame.capture else [])
        try:
            registration = register_capture(
                here, self.frame.images(native if own is None else []), self.frame.band(),
                own, region, options, given, partial(self.frame.ready, native, region, own),
            )  # fmt: skip
        except RegistrationRefused as error:
            refused = error
        if capture is self.frame.capture and registration is not None:
            self.frame.own = registration
            self.frame.settle()
        if self.frame.made_ready is not None:
            self.frame.made_ready.release()
        record = record_of(
            registration, refused, capture, here, grid, self.frame.description(), sampling,
            self.frame.channel(capture), options.get("method", DEFAULT_METHOD),
        )  # fmt: skip
        problems = _verdict_problems(record, capture, refused)
        figures = []
        if registration is not None and registration.trace is not None:
            figures = draw_trace(registration.matches, registration.trace)
        drawn = [[figure.svg, figure.caption] for figure in figures] or _drawn(record)
        return Measured.of(record, registration, problems), drawn

    def _adjusted(self, capture: Capture) -> Measured:
        from levkas.building.joint import adjusted

        is_reference = capture is self.frame.capture
        reference = None if is_reference else self.frame.registration().sigma
        found = adjusted(self.mates.read(capture), self.mates.there(capture), reference)
        return replace(
            found, problems=found.problems or _verdict_problems(found.record, capture, None)
        )

    def _unwritten(self, capture: Capture) -> Step | None:
        for job in self.being_written(capture):
            if (calibrated := job.result()).state == "refused":
                return calibrated
        return None

    def _publish(
        self,
        key: Key,
        prints: dict[str, Any],
        capture: Capture,
        why: str,
        measured: Measured,
        figures: list[list[str]],
        started: float,
    ) -> Step:
        from levkas.building.register import write_registration
        from levkas.core.files import together

        record, problems = measured.record, measured.problems
        with together(partial(self.ledger.forget, key)):
            files = write_registration(self.places, capture, record, measured.matches)
        notes: dict[str, Any] = {
            "seconds": round(time.monotonic() - started, 2),
            "refused": [p.to_dict() for p in problems],
            "figures": figures,
        }
        self.ledger.keep(key, prints, files, **notes)
        if problems:
            return Step(key, "refused", problems[0].message, problems=problems)
        verdict = record["verdict"]
        warned = (
            ()
            if verdict["decision"] != "warn"
            else (f"{capture.object}/{capture.layer}: {' '.join(verdict['reasons'])}",)
        )
        return Step(key, "done", why, warnings=warned)


def _drawn(record: dict[str, Any]) -> list[list[str]]:
    """Return the figures, SVG and caption each, of what a map rests on; none where the record does not say."""
    from levkas.pages.figures import draw_basis

    figures = draw_basis(record["trace"], record["reference"]["size"])
    return [[figure.svg, figure.caption] for figure in figures]


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
