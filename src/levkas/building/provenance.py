"""provenance.json of an object: what every stage was made of, so that a publication can say it."""

from __future__ import annotations

from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from levkas import __version__
from levkas.building import fingerprints
from levkas.building.graph import keys_of
from levkas.building.sources import LIBRARIES
from levkas.calibration.sensor_context import Times, times_of
from levkas.core.problems import Refused
from levkas.readers.frames import files_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.building.build_records import BuildRecords, Key
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture

FRAME = "frame "
"""Begins what a fingerprint says of the use of a file as a frame."""
NAME = "provenance.json"
FILE = "file "
"""Begins the names of input files in a fingerprint."""


def provenance_of(
    campaign: Campaign, ledger: BuildRecords, name: str, captures: Sequence[Capture]
) -> dict[str, Any]:
    """Return what the stages of an object were made of.

    Returns
    -------
    record : dict
        ``levkas`` and ``libraries``: versions. ``steps``: of every stage that has ended well, in order,
        ``camera``, ``setup``, ``stage``, ``code`` (hash of the sources that it rests on),
        ``parameters``, ``inputs`` and ``products`` (SHA-256 by relative path; of products not the Zarr
        chunks, which hold the same numbers as the TIFFs); of a calibration ``frames`` too: of every
        frame its role, what its name says, its exposure in s, and the SHA-256 of all its files.
    """
    steps = []
    for capture in captures:
        for key in keys_of(campaign, capture).values():
            if step := _step(ledger, key):
                frames = _frames(campaign, capture, step["inputs"])
                steps.append(step | ({"frames": frames} if key.stage == "calibrate" else {}))
    return {"object": name, "levkas": __version__, "libraries": _libraries(), "steps": steps}


def _step(ledger: BuildRecords, key: Key) -> dict[str, Any]:
    prints, products = ledger.fingerprint(key), ledger.products(key)
    if not prints:
        return {}
    inputs = {k.removeprefix(FILE): v for k, v in prints.items() if k.startswith(FILE)}
    parameters = {
        k: v
        for k, v in prints.items()
        if not k.startswith((FILE, FRAME)) and k != "code" and v is not None
    }
    return {
        "camera": key.camera,
        "setup": key.setup,
        "stage": key.stage,
        "code": prints.get("code", ""),
        "parameters": parameters,
        "inputs": inputs,
        "products": {n: sha for n, sha in products.items() if not n.startswith("zarr/")},
    }


def _frames(campaign: Campaign, capture: Capture, inputs: dict[str, str]) -> list[dict[str, Any]]:
    """Describe every frame of a capture that was read."""
    told = []
    for sensor, role, frame in fingerprints.frames_of(capture):
        names = [fingerprints.relative(campaign, path) for path in files_of(frame.path)]
        seconds: Times = frame.exposure_s
        with suppress(Refused, OSError):
            seconds = times_of(frame)
        use = fingerprints.use_of(sensor, role, frame)
        if seconds is not None:
            use["exposure_s"] = list(seconds) if isinstance(seconds, tuple) else seconds
        told.append({**use, "files": {name: inputs.get(name, "") for name in names}})
    return told


def _libraries() -> dict[str, str]:
    found = {}
    for name in sorted(LIBRARIES.values()):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # another build of the same library: its version is not known
            continue
    return found
