"""Notes on objects as W3C Web Annotations: read by a narrow grammar, put into manifests and pages.

The viewer writes and reads the same files (``frontend/src/viewer/annotations.ts``): an AnnotationPage
whose annotations have plain text as body, and as target the object's IIIF canvas with an ``xywh`` fragment
or an SVG of one polygon or circle. Everything else is refused, so that nothing in a file can run in a page."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn
from urllib.parse import quote, unquote

from levkas.core.problems import Problem, closest_match
from levkas.core.text import CONTROL, read_json
from levkas.publish.publication import PublishRefused

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

FOLDER = "notes"
"""Beside campaign.toml: its files are published."""
LARGEST_FILE = 2_000_000
MOST_NOTES = 500
"""Of one object."""
LONGEST_TEXT, LONGEST_AUTHOR, LONGEST_SELECTOR = 4000, 100, 8000
MOST_CORNERS = 200
ROUNDING = 0.06
"""Px: places are written to a tenth."""
PLAIN = "text/plain"
SVG = ('<svg xmlns="http://www.w3.org/2000/svg">', "</svg>")
_N = r"([0-9]{1,6}(?:\.[0-9]{1,6})?)"
_FRAGMENT = re.compile(rf"xywh=(?:pixel:)?{_N},{_N},{_N},{_N}")
_CIRCLE = re.compile(rf'<circle cx="{_N}" cy="{_N}" r="{_N}"\s?/>')
_POLYGON = re.compile(r'<polygon points="([0-9., ]+)"\s?/>')
_CORNER = re.compile(rf"{_N},{_N}")
_DATE = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}"
    r"(T[0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,6})?)?(Z|[+-][0-9]{2}:[0-9]{2})?)?"
)
_MARKUP = re.compile(r"<[A-Za-z/!?]")
_CANVAS = re.compile(r"(?:^|/)iiif/([^/]+)/canvas$")


@dataclass(frozen=True)
class Annotations:
    """Notes to publish, by object, and the address under which the publication is found.

    Parameters
    ----------
    base : str
        Address of the publication's folder, with ``/`` at its end.
    sizes : mapping
        Width and height of each object's canvas, px.
    items : mapping
        Annotations of each object, as `read_annotations` has them, without id and target's source.
    """

    base: str
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    items: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)

    def canvas(self, name: str) -> str:
        """Return the address of an object's canvas."""
        return f"{self.base}iiif/{quote(name, safe='@')}/canvas"

    def of(self, name: str) -> list[dict[str, Any]]:
        """Return an object's annotations, with ids and targets in this publication."""
        canvas = self.canvas(name)
        return [
            {
                "id": f"{canvas}/notes/{number}",
                **note,
                "target": {"type": "SpecificResource", "source": canvas, **note["target"]},
            }
            for number, note in enumerate(self.items.get(name, ()), 1)
        ]

    def describe(self, name: str, size: tuple[int, int]) -> dict[str, Any]:
        """Return what an object's page needs: its canvas and its notes; `size` where no canvas is known."""
        width, height = self.sizes.get(name, size)
        manifest = f"{self.canvas(name).removesuffix('canvas')}manifest.json"
        facts = {"id": self.canvas(name), "manifest": manifest, "width": width, "height": height}
        return {"canvas": facts, "notes": self.of(name)}


def find_annotations(path: Path) -> tuple[Path, ...]:
    """Return the files of notes that a path names: itself, or all ``*.json`` of a folder, in order."""
    if not path.is_dir():
        return (path,)
    found = tuple(sorted(p for p in path.iterdir() if p.suffix == ".json"))
    if not found:
        raise PublishRefused(
            Problem(
                "E_UNREADABLE",
                "no file of notes was found here",
                str(path),
                found="a folder without *.json",
                expected="files that the viewer exported",
                fix="Move the exported notes there, or name them with --notes.",
            )
        )
    return found


def annotations_of(publication: Publication) -> Annotations:
    """Return the notes that a publication carries, on its canvases."""
    entries = publication.entries()
    sizes = {entry.object: (entry.width, entry.height) for entry in entries}
    items = read_annotations(publication.notes, sizes) if publication.notes else {}
    return Annotations(publication.base, sizes, items)


def read_annotations(
    paths: Iterable[Path],
    sizes: Mapping[str, tuple[int, int]],
) -> dict[str, list[dict[str, Any]]]:
    """Read files of notes; the target of each note says of which object it is.

    Parameters
    ----------
    paths : iterable of Path
    sizes : mapping
        Width and height of each object's canvas, px; a target that states others is scaled.

    Returns
    -------
    items : dict
        Annotations of each object, in its canvas' pixels. Of those with one id the last one counts.

    Raises
    ------
    PublishRefused
        Where a file is no AnnotationPage in the grammar, or a note lies outside its object.
    TextRefused
        Where a file cannot be read or is no JSON.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for path in paths:
        reader = _Reader(path, sizes)
        for number, (name, key, note) in enumerate(reader.read()):
            notes = found.setdefault(name, {})
            key = key or f"{path.name} {number}"
            notes.pop(key, None)
            notes[key] = note
            if len(notes) > MOST_NOTES:
                reader.refuse("items", len(notes), f"at most {MOST_NOTES} notes of one object")
    return {name: list(notes.values()) for name, notes in found.items()}


class _Reader:
    """Reads one file; what is wrong is refused with the field that it stands in."""

    def __init__(
        self,
        path: Path,
        sizes: Mapping[str, tuple[int, int]],
    ) -> None:
        self.path, self.sizes = path, sizes

    def refuse(self, where: str, found: Any, expected: str) -> NoReturn:
        raise PublishRefused(
            Problem(
                "E_VALUE",
                f"{self.path.name} is not a valid file of notes",
                str(self.path),
                where,
                found,
                expected,
                "Export the notes from the viewer again, or remove this file.",
            )
        )

    def read(self) -> Iterable[tuple[str, str, dict[str, Any]]]:
        """Yield the object, the id, where there is one, and the annotation of each note."""
        page = read_json(self.path)
        if self.path.stat().st_size > LARGEST_FILE:
            self.refuse("", f"over {LARGEST_FILE / 1e6:g} MB", "a smaller file")
        if page.get("type") != "AnnotationPage":
            self.refuse("type", page.get("type"), "AnnotationPage")
        items = page.get("items")
        if not isinstance(items, list) or len(items) > MOST_NOTES:
            found = len(items) if isinstance(items, list) else items
            self.refuse("items", found, f"a list of at most {MOST_NOTES} annotations")
        for number, item in enumerate(items):
            yield self._note(item, f"items[{number}]")

    def _note(self, value: Any, where: str) -> tuple[str, str, dict[str, Any]]:
        item = self._table(value, where)
        found: Any
        for key, expected in (("type", "Annotation"), ("motivation", "commenting")):
            if (found := item.get(key, "commenting")) != expected:
                self.refuse(f"{where}.{key}", found, expected)
        body = self._table(_single(item.get("body")), f"{where}.body")
        for key, expected in (("type", "TextualBody"), ("format", PLAIN)):
            if (found := body.get(key, PLAIN)) != expected:
                self.refuse(f"{where}.body.{key}", found, expected)
        text = self._plain(body.get("value"), f"{where}.body.value", LONGEST_TEXT)
        modified = item.get("modified", item.get("created", ""))
        if modified != "" and not (isinstance(modified, str) and _DATE.fullmatch(modified)):
            self.refuse(f"{where}.modified", modified, "a date as ISO 8601 has it")
        name, target = self._target(_single(item.get("target")), f"{where}.target")
        author = self._author(_single(item.get("creator")), f"{where}.creator")
        note = {
            "type": "Annotation",
            "motivation": "commenting",
            **({"modified": modified} if modified else {}),
            **({"creator": {"type": "Person", "name": author}} if author else {}),
            "body": {"type": "TextualBody", "value": text, "format": PLAIN},
            "target": target,
        }
        key = item.get("id", "")
        return name, key if isinstance(key, str) else "", note

    def _author(self, value: Any, where: str) -> str:
        if value is None:
            return ""
        name = value if isinstance(value, str) else self._table(value, where).get("name")
        return self._plain(name, where, LONGEST_AUTHOR)

    def _target(self, value: Any, where: str) -> tuple[str, dict[str, Any]]:
        """Return the object, and the selector in its canvas' pixels."""
        if isinstance(value, str):
            address, _, fragment = value.partition("#")
            value = {"source": address, "selector": {"type": "FragmentSelector", "value": fragment}}
        target = self._table(value, where)
        source = target.get("source")
        canvas = self._table({"id": source} if isinstance(source, str) else source, where)
        named = canvas.get("id")
        match = _CANVAS.search(named) if isinstance(named, str) else None
        name = unquote(match[1]) if match else ""
        if name not in self.sizes:
            hint = closest_match(name, self.sizes)
            expected = "…/iiif/OBJECT/canvas, for an object of this database"
            expected += f". {hint}" if hint else ""
            self.refuse(f"{where}.source", named, expected)
        width, height = self.sizes[name]
        size = canvas.get("width", width), canvas.get("height", height)
        if not all(_is_size(side) for side in size):
            self.refuse(f"{where}.source", size, "a width and a height in pixels")
        scale = width / size[0]
        if abs(size[1] * scale - height) > 2 + 2 * scale:
            self.refuse(f"{where}.source", size, f"a canvas with the sides of {width} x {height}")
        selector = self._table(_single(target.get("selector")), f"{where}.selector")
        kind, text = selector.get("type"), selector.get("value")
        where = f"{where}.selector"
        if not isinstance(text, str) or len(text) > LONGEST_SELECTOR:
            self.refuse(f"{where}.value", text, f"a text of at most {LONGEST_SELECTOR} characters")
        if kind == "FragmentSelector":
            return name, {"selector": self._fragment(text, where, size, scale)}
        if kind != "SvgSelector":
            self.refuse(f"{where}.type", kind, "FragmentSelector or SvgSelector")
        return name, {"selector": self._svg(text, where, size, scale)}

    def _fragment(
        self, text: str, where: str, size: tuple[float, float], scale: float
    ) -> dict[str, Any]:
        match = _FRAGMENT.fullmatch(text)
        if not match:
            self.refuse(f"{where}.value", text, "xywh=X,Y,WIDTH,HEIGHT in pixels")
        x, y, w, h = map(float, match.groups())
        self._inside(x + w, y + h, where, size)
        numbers: list[float] = [_tenth(v * scale) for v in (x, y, w, h)]
        if w <= 1 and h <= 1:  # a place, which stays one pixel
            middle = zip((x + w / 2, y + h / 2), size, strict=True)
            corner = (math.floor(min(at, side - 0.5) * scale) for at, side in middle)
            numbers = [*corner, 1, 1]
        value = ",".join(f"{v:g}" for v in numbers)
        conforms = {"conformsTo": "http://www.w3.org/TR/media-frags/"}
        return {"type": "FragmentSelector", **conforms, "value": f"xywh={value}"}

    def _svg(
        self, text: str, where: str, size: tuple[float, float], scale: float
    ) -> dict[str, Any]:
        svg = text.strip().replace("'", '"')
        inner = ""
        if svg.startswith(SVG[0]) and svg.endswith(SVG[1]):
            inner = svg[len(SVG[0]) : -len(SVG[1])].strip()
        expected = f"an svg of one circle, or of one polygon of 3 to {MOST_CORNERS} corners"
        if match := _CIRCLE.fullmatch(inner):
            x, y, r = map(float, match.groups())
            self._inside(x, y, where, size)
            self._inside(r, r, where, (max(size), max(size)))
            x, y, r = (_tenth(v * scale) for v in (x, y, r))
            return _selector(f'<circle cx="{x:g}" cy="{y:g}" r="{r:g}"/>')
        match = _POLYGON.fullmatch(inner)
        corners = [_CORNER.fullmatch(corner) for corner in match[1].split()] if match else []
        if not 3 <= len(corners) <= MOST_CORNERS or None in corners:
            self.refuse(f"{where}.value", text, expected)
        places = []
        for corner in filter(None, corners):
            x, y = float(corner[1]), float(corner[2])
            self._inside(x, y, where, size)
            places.append(f"{_tenth(x * scale):g},{_tenth(y * scale):g}")
        return _selector(f'<polygon points="{" ".join(places)}"/>')

    def _inside(self, x: float, y: float, where: str, size: tuple[float, float]) -> None:
        if x > size[0] + ROUNDING or y > size[1] + ROUNDING:
            expected = f"a place on the painting, {size[0]:g} x {size[1]:g} px"
            self.refuse(f"{where}.value", f"{x:g}, {y:g}", expected)

    def _table(self, value: Any, where: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            self.refuse(where, value, "a table of keys and values")
        return value

    def _plain(self, value: Any, where: str, longest: int) -> str:
        if not isinstance(value, str) or len(value) > longest:
            self.refuse(where, value, f"a text of at most {longest} characters")
        if _MARKUP.search(value) or CONTROL.search(value):
            self.refuse(where, value, "plain text, without markup and control characters")
        return value


def _selector(inner: str) -> dict[str, Any]:
    return {"type": "SvgSelector", "value": inner.join(SVG)}


def _single(value: Any) -> Any:
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _is_size(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value <= 1e6


def _tenth(value: float) -> float:
    return round(value, 1)
