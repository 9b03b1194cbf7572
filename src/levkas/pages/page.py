"""The report page of one object, and the templates of all pages."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files as resources
from typing import TYPE_CHECKING, Any

from levkas.registration.advice import percent
from levkas.registration.record import DECISIONS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import jinja2


WORTH_NAMING = 0.1
"""Share of a layer that was not checked, from which on it is named beside the decision."""


def describe_decision(decision: str, unchecked: float = 0.0, area: str = "") -> str:
    """Return a decision of a record in words, with the share of the layer that was checked, and the area of the rest.

    >>> describe_decision("warn"), describe_decision("accept", 0.214, "340 mm²")
    ('doubtful, please check', 'accepted, checked over 79 % of the layer (not in 340 mm²)')
    """
    words = DECISIONS.get(decision, decision)
    if decision != "accept" or unchecked < WORTH_NAMING:
        return words
    rest = f" (not in {area})" if area else ""
    return f"{words}, checked over {percent(1 - unchecked)} of the layer{rest}"


@dataclass(frozen=True)
class Figure:
    """A drawing as SVG text, with what a reader should see in it."""

    svg: str
    caption: str


@dataclass(frozen=True)
class LayerReport:
    """What the page says of one camera under one setup; texts are plain, the page escapes them."""

    name: str
    bands: Sequence[str]
    quantity: str
    decision: str
    method: str
    decided: str = ""
    model: str = ""
    error_px: float | None = None
    checked: float | None = None
    reasons: Sequence[str] = ()
    next_step: str = ""
    warnings: Sequence[str] = ()
    earlier: str = ""
    """Why the layer is of an earlier build; empty where it is of this one."""
    lying: str = ""
    by_hand: str = ""
    unchecked: float = 0.0
    outside: float = 0.0
    unchecked_area: str = ""
    error: str = "–"
    checks: str = ""
    ssim: str = "–"
    flags: str = ""
    preview: str = ""
    description: str = ""
    figures: Sequence[Figure] = ()
    history: Sequence[Figure] = ()
    maps: Sequence[Any] = ()
    links: Sequence[tuple[str, str]] = ()
    ssim_map: str = ""
    recorded: str = ""
    """Of a layer that was refused: its picture as it was recorded, as data address."""
    budget: Any = None

    @property
    def decision_text(self) -> str:
        """The decision in a user's word."""
        words = self.decided if self.decision == "confirmed" else self.decision
        return describe_decision(words, self.unchecked, self.unchecked_area)

    @property
    def anchor(self) -> str:
        """A name that is safe in a link."""
        return "layer-" + "".join(c if c.isalnum() else "-" for c in self.name)


def render_page(template: str, /, *, package: str = "levkas.pages", **values: Any) -> str:
    """Return a page as HTML by one of the templates in a package; every text from outside is escaped."""
    return str(_templates_of(package).get_template(template).render(**values))


@cache
def _templates_of(package: str) -> jinja2.Environment:
    """Return the templates that lie in a package, each compiled once in a process."""
    import jinja2

    def read(name: str) -> str:
        return resources(package).joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(read), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["coded"] = mark_code
    return environment


def mark_code(text: str) -> Any:
    """Return text as HTML in which text between backticks is code; everything else is escaped.

    >>> str(mark_code("run `a <b>` & c"))
    'run <code>a &lt;b&gt;</code> &amp; c'
    """
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def embed_png(data: bytes) -> str:
    """Return PNG bytes as a data address that an image tag can show."""
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def describe_flags(shares: dict[str, float]) -> str:
    """Report the share of pixels under each flag: ``saturated 0.4 %``; shares below 0.005 % are left out.

    >>> describe_flags({"saturated": 0.004, "outside": 0.0})
    'saturated 0.40 %'
    """
    parts = [f"{name} {100 * share:.2f} %" for name, share in shares.items() if share >= 5e-5]
    return ", ".join(parts) or "none"


def describe_model(model: dict[str, Any]) -> str:
    """Report the model of a registration in words.

    >>> describe_model({"kind": "levkas", "sensors": [{"base": "cubic", "chromatic": "affine"}]})
    'cubic; shift between bands: affine'
    """
    parts = []
    for sensor in model.get("sensors", []):
        if not isinstance(sensor, dict):
            continue
        base, apart = sensor.get("base"), sensor.get("chromatic")
        if isinstance(base, str) and base.startswith("shared"):
            base = base.replace("shared", "one map with other captures", 1)
        name = f"{sensor['sensor']}: " if sensor.get("sensor") else ""
        parts.append(name + (f"{base}; " if base else "") + f"shift between bands: {apart}")
    mask = model.get("mask") or {}
    if mask.get("outline"):
        whose = (
            "the outline found on an even ground" if mask["automatic"] else "the declared outline"
        )
        parts.append(f"compared within {whose}, {percent(mask['share'])} of the reference")
    return "; ".join(parts) or str(model.get("kind", "")).replace("_", " ")
