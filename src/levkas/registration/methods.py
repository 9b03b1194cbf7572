"""Registration methods: a row each, with the options that campaign.toml takes for it.

A row holds what a campaign has to know of a method, so that it can be checked without the registration
itself; `levkas.registration.run` binds the functions of the built-in ones. An installed package adds a method by an
entry point of the group `levkas.registration`: its name is the method's, and it loads a `Method`. What
cannot be loaded is named in a warning; only campaigns that choose it are refused.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict

GROUP = "levkas.registration"
DEFAULT_METHOD = "levkas"


class MethodOptions(BaseModel):
    """Options of a method, keys of [registration]; None is the method's own default."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LevkasOptions(MethodOptions):
    """Options of the default method.

    Parameters
    ----------
    reject, stop : float, reference px
        The thresholds of the paper's method, which change nothing here.
    """

    reject: Annotated[float, Strict(), Field(gt=0)] | None = None
    stop: Annotated[float, Strict(), Field(gt=0)] | None = None


class PaperOptions(MethodOptions):
    """Options of the method of [mirhashemi2019]_; errors in reference px.

    Parameters
    ----------
    reject, stop : float, reference px
        T1, by default 1/16 of the reference's diagonal, and T2, by default 1.
    ratio : float
        Largest ratio of nearest to second nearest descriptor, by default 0.9.
    order : int
        Of the polynomial, by default 3.
    detector, matching : str
        Keys of `features.DETECTORS` and `matching.MATCHERS`.
    """

    reject: Annotated[float, Strict(), Field(gt=0)] | None = None
    stop: Annotated[float, Strict(), Field(gt=0)] | None = None
    ratio: Annotated[float, Strict(), Field(gt=0, le=1)] | None = None
    order: Annotated[int, Strict(), Field(ge=1, le=5)] | None = None
    detector: Literal["sift", "orb"] | None = None
    matching: Literal["mutual-ratio", "mutual", "ratio"] | None = None


@dataclass(frozen=True)
class Method:
    """One registration method.

    Parameters
    ----------
    options : type of BaseModel
        Its keys in [registration]; every field has a default.
    register : callable, optional
        ``register(request, options)`` of a `levkas.registration.Request` returns a `Registration`. The
        built-in methods' are bound in `levkas.registration.run`.
    ineffective : frozenset of str
        Options that are accepted and change nothing.
    per_sensor : bool
        Whether every sensor of a camera has matches of its own.
    begins : bool
        Whether it tries candidates of a start, `ManualPoints.starts`.
    prepared : bool
        Whether the prepared reference is all that it takes of the reference's bands, which are then freed.
    """

    options: type[BaseModel]
    register: Callable[[Any, Any], Any] | None = None
    ineffective: frozenset[str] = frozenset()
    per_sensor: bool = True
    begins: bool = False
    prepared: bool = False


METHODS = {
    "levkas": Method(
        LevkasOptions,
        ineffective=frozenset({"reject", "stop"}),
        begins=True,
        prepared=True,
    ),
    "mirhashemi2019": Method(PaperOptions, per_sensor=False),
}


#: Method of an installed package → why it cannot be used.
UNUSABLE: dict[str, str] = {}
#: Method of an installed package → its module.
_MODULES: dict[str, str] = {}


def method_of(keys: dict[str, Any]) -> Method:
    """Return the method that keys of [registration] name, else the default one."""
    return METHODS[keys.get("method") or DEFAULT_METHOD]


@cache
def code_of(name: str) -> str:
    """Return the hash of the code of an installed package's method: all modules of its top package; empty of a built-in one.

    >>> code_of("levkas")
    ''
    """
    if name not in _MODULES:
        return ""
    path = Path(str(import_module(_MODULES[name].partition(".")[0]).__file__))
    files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.relative_to(path.parent).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def owners_of(option: str) -> list[str]:
    """Return the names of the methods that have an option with effect.

    >>> owners_of("ratio")
    ['mirhashemi2019']
    """
    return [
        name
        for name, method in METHODS.items()
        if option in method.options.model_fields and option not in method.ineffective
    ]


def _load_installed() -> None:
    """Add the methods of installed packages; warn of those that cannot be used."""
    for entry in entry_points(group=GROUP):
        try:
            found = entry.load()
        except Exception as error:  # whatever the code of another package raises
            UNUSABLE[entry.name] = f"{entry.value} raises {type(error).__name__}: {error}"
            continue
        if not (isinstance(found, Method) and callable(found.register)):
            UNUSABLE[entry.name] = f"{entry.value} is not a Method with a function"
        elif METHODS.setdefault(entry.name, found) is found:
            _MODULES[entry.name] = entry.module
    for name, why in UNUSABLE.items():
        warnings.warn(f"the registration method {name!r} cannot be used: {why}", stacklevel=2)


# Last, so that a package whose method is loaded finds all names of this module.
_load_installed()
