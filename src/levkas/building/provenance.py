"""provenance.json of an object: what every stage was made of, so that a publication can say it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from levkas import __version__
from levkas.building.rig_mates import joint_keys

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.building.ledger import Key, Ledger
    from levkas.campaign import Campaign
    from levkas.discovery import Capture

NAME = "provenance.json"
LIBRARIES = (
    "imagecodecs",
    "numba",
    "numpy",
    "opencv-python-headless",
    "rawpy",
    "scipy",
    "tifffile",
)
"""Whose version may be in the numbers."""
FILE = "file "
"""Begins the names of input files in a fingerprint."""


def provenance_of(
    campaign: Campaign, ledger: Ledger, name: str, captures: Sequence[Capture]
) -> dict[str, Any]:
    """Return what the stages of an object were made of.

    Returns
    -------
    record : dict
        ``levkas`` and ``libraries``: versions. ``steps``: of every stage that has ended well, in order,
        ``camera``, ``setup``, ``stage``, ``code`` (hash of the sources that it rests on),
        ``parameters``, ``inputs`` and ``products`` (SHA-256 by relative path; of products not the Zarr
        chunks, which hold the same numbers as the TIFFs).
    """
    keys = [key for capture in captures for key in joint_keys(campaign, capture).values()]
    steps = [step for key in keys if (step := _step(ledger, key))]
    return {"object": name, "levkas": __version__, "libraries": _libraries(), "steps": steps}


def _step(ledger: Ledger, key: Key) -> dict[str, Any]:
    prints, products = ledger.fingerprint(key), ledger.products(key)
    if not prints:
        return {}
    inputs = {k.removeprefix(FILE): v for k, v in prints.items() if k.startswith(FILE)}
    parameters = {
        k: v for k, v in prints.items() if not k.startswith(FILE) and k != "code" and v is not None
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


def _libraries() -> dict[str, str]:
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # another build of the same library: its version is not known
            continue
    return found
