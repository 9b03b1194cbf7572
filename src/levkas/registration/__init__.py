"""Registration: which pixel of which band of which camera shows which point of the reference.

A method is a row of `levkas.registration.methods.METHODS`: the model of its options, and a function of a `Request` and these options that
returns a `Registration`. Names are loaded when they are first used: a campaign needs the table of methods alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from levkas.registration.bands import BandImage
    from levkas.registration.methods import METHODS, Method
    from levkas.registration.record import (
        Matches,
        Registration,
        RegistrationRefused,
        Trace,
        Verdict,
    )
    from levkas.registration.request import Request
    from levkas.registration.run import register

__all__ = [
    "METHODS",
    "BandImage",
    "Matches",
    "Method",
    "Registration",
    "RegistrationRefused",
    "Request",
    "Trace",
    "Verdict",
    "register",
]
_HOMES = {
    "METHODS": "methods",
    "Method": "methods",
    "BandImage": "bands",
    "Request": "request",
    "register": "run",
}
"""Name → module; the others are of `record`."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES.get(name, 'record')}"), name)
