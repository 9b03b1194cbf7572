"""Bands in names: the one part in which files of one object differ, by what it is, else by what the frames show."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.listing import CaptureFile
from levkas.campaign.guess.words import (
    BANDS,
    COLOUR_LETTERS,
    COLOURS,
    IMAGES,
    LENSES,
    LIGHTS,
    NUMBERED_BANDS,
    SHELL,
    Token,
    are_elements,
    joined,
    role_in,
)

Tokens = dict[Path, tuple[Token, ...]]
Place = tuple[tuple[str, ...], str]
"""Names of the folders, and the other parts of a name: what files of one set of bands have in common."""

LETTERS = ({"r", "g", "b"}, {"red", "green", "blue"})
"""Sets of values of which all must be there for single letters to be colours: r and v are recto and verso, too."""
CODE = re.compile(r"(?P<before>[A-Za-z]{0,3})(?P<number>\d{3,4})(?P<after>[A-Za-z]{1,3})")
"""``MB450RB`` of a MegaVision, ``450N``: a wavelength between letters."""
NUMBERED = re.compile(r"(?P<before>[A-Za-z]{0,3})(?P<number>[1-9]\d{2,3})(?P<after>[A-Za-z]{0,3})")
"""The same with letters or without: ``W385``, ``450``; darks and whites of the same numbers say that it is one."""
EXPOSED = re.compile(r"(?i)(exp?|t|it|int)?\d")
"""Numbers that may be exposures."""
COUNTED = re.compile(r"(?P<before>[A-Za-z]+)(?P<number>\d{1,3})(?P<after>[A-Za-z]?)")
RANGE_NM, LEAST_STEP_NM = (300.0, 2600.0), 4.0
MOST_VALUES, FEWEST = 64, 2
"""Values of one part of the names; nobody has more bands in files of their own whose names have no unit."""
LOOKED_AT, SETS = 9, 3
"""Frames of a set that are decoded, and sets; all bands of a set are looked at where there are no more."""


class Frames(Protocol):
    """What the pixels of some frames show, as `levkas.campaign.guess.pixels.Samples` reads them."""

    def same_scene(self, one: CaptureFile, other: CaptureFile) -> bool | None:
        """Whether two frames are shots of one scene; None where one cannot be decoded."""

    def shows_something(self, capture: CaptureFile) -> bool:
        """Whether a frame has more structure than a dark or white."""

    def is_proportional(self, one: CaptureFile, other: CaptureFile) -> bool:
        """Whether two frames differ in brightness alone."""

    def show_the_same(self, captures: Sequence[CaptureFile]) -> bool | None:
        """Whether frames show one object in fine detail; None where they do not decide it."""


@dataclass(frozen=True)
class Question:
    """Files of which neither names nor pixels show whether they are bands of one object or several objects."""

    files: tuple[CaptureFile, ...]
    values: tuple[str, ...]


@dataclass(frozen=True)
class _Column:
    """One part of the names of a cluster, its values, and sets of files that differ in it alone: objects', if any.

    `templates` are sets of the same values of darks and whites.
    """

    index: int
    values: tuple[str, ...]
    sets: tuple[dict[str, CaptureFile], ...]
    templates: tuple[dict[str, CaptureFile], ...] = ()

    def without_blanks(self, samples: Frames) -> _Column:
        """Return the column with sets of frames that show nothing among the templates, where others show something."""
        blank = [one for one in self.sets[:LOOKED_AT] if not _shows_something(one, samples)]
        shown = tuple(one for one in self.sets if one not in blank)
        return replace(self, sets=shown, templates=(*self.templates, *blank)) if shown else self


def mark_bands(
    captures: Sequence[CaptureFile], tokens: Tokens, samples: Frames, *, undecided_as_bands: bool
) -> tuple[Tokens, list[Question]]:
    """Mark the part of names that is a band or a wavelength.

    Parameters
    ----------
    captures : sequence of CaptureFile
    tokens : dict of path to tokens
    samples : Frames
        Compares frames where names do not decide.
    undecided_as_bands : bool
        Whether what nothing decides is taken for bands.

    Returns
    -------
    tokens : dict of path to tokens
        The part is of kind ``"wavelength"``, ``"band"`` or ``"sensor"``, with the reason.
    questions : list of Question
        What nothing decides.
    """
    tokens = _with_shells(captures, tokens)
    sizes: dict[str, set[object]] = defaultdict(set)
    for capture in captures:
        for text in (*capture.folders, *(t.text for t in tokens[capture.path])):
            sizes[text].add(capture.signature)
    clusters = [
        (cluster, [column.without_blanks(samples) for column in _columns(cluster, tokens)])
        for cluster in _clusters(captures, tokens)
    ]
    marked, known = dict(tokens), dict[tuple[str, ...], tuple[str, str]]()
    undecided: list[tuple[list[CaptureFile], list[_Column]]] = []
    for cluster, columns in clusters:
        found = next(((c, kind) for c in columns if (kind := _by_name(c, samples))), None) or next(
            (
                (c, kind)
                for c in columns
                if (kind := _by_pixels(c, cluster, sizes, samples, undecided_as_bands))
            ),
            None,
        )
        if found is None:
            undecided.append((cluster, columns))
            continue
        column, kind = found
        known[column.values] = kind
        marked |= _marked(column, cluster, tokens, *kind)
    questions = []
    for cluster, columns in undecided:
        if same := next((c for c in columns if c.values in known), None):
            marked |= _marked(same, cluster, tokens, *known[same.values])
        elif len(columns) == 1 and not any(_has_role(c, tokens) for c in cluster):
            (column,) = columns
            if (
                _may_be_bands(column, cluster, sizes, samples)
                and _shows_one(column, samples) is None
            ):
                files = tuple(c for one in column.sets for c in one.values())
                questions.append(Question(files, column.values))
    return marked, questions


def _with_shells(captures: Sequence[CaptureFile], tokens: Tokens) -> Tokens:
    """Make one part of an element and its shell, ``Pb_L``, where the files of a folder name several so."""
    folders: dict[tuple[object, ...], list[CaptureFile]] = defaultdict(list)
    for capture in captures:
        folders[capture.folders, len(tokens[capture.path])].append(capture)
    made = dict(tokens)
    for files in folders.values():
        for index in range(len(tokens[files[0].path]) - 1):
            pairs = {c.path: tokens[c.path][index : index + 2] for c in files}
            names = {path: joined(pair) for path, pair in pairs.items()}
            shells = all(re.fullmatch(SHELL, pair[1].text) for pair in pairs.values())
            if not (shells and are_elements(sorted(set(names.values())))):
                continue
            for path, (element, _) in pairs.items():
                whole = Token(names[path], element.gap)
                made[path] = (*tokens[path][:index], whole, *tokens[path][index + 2 :])
    return made


# --- columns ----------------------------------------------------------------------------------


def _clusters(captures: Sequence[CaptureFile], tokens: Tokens) -> list[list[CaptureFile]]:
    """Group frames of one channel and one size whose names have as many parts, with the same between them."""
    found: dict[object, list[CaptureFile]] = defaultdict(list)
    for capture in captures:
        facts = capture.facts
        if facts.is_cube or facts.kind == "raw" or facts.pages > 1 or facts.wavelengths:
            continue
        parts = tokens[capture.path]
        gaps = tuple(t.gap for t in parts)
        key = (
            len(capture.folders),
            capture.path.suffix.lower(),
            facts.shape[:2],
            facts.dtype,
            gaps,
        )
        found[key].append(capture)
    return [group for group in found.values() if len(group) > 1]


def _columns(cluster: Sequence[CaptureFile], tokens: Tokens) -> Iterator[_Column]:
    """Yield the parts of names that could be bands, from the right: every set of files has the same values of it."""
    rows = [tokens[c.path] for c in cluster]
    varying = [i for i in range(len(rows[0])) if len({row[i].text for row in rows}) > 1]
    for index in reversed(varying):
        column = [row[index] for row in rows]
        values = tuple(sorted({t.text for t in column}, key=natural))
        roles = {t.role for t in column} - {""}
        if (
            roles
            or column[0].kind in ("time", "wavelength", "exposure")
            or len(values) > MOST_VALUES
        ):
            continue
        followers = {i for i in varying if i != index and _follows(rows, i, index)}
        others = [i for i in varying if i not in {index, *followers}]
        sets: dict[Place, dict[str, CaptureFile]] = defaultdict(dict)
        for capture, row in zip(cluster, rows, strict=True):
            place = capture.folders, "\0".join(row[i].text for i in others)
            sets[place][row[index].text] = capture
        whole = [found for found in sets.values() if len(found) == len(values)]
        alone = sum(len(found) for found in sets.values()) == len(
            cluster
        )  # no file is lost: no shots
        if alone and len(values) >= FEWEST and 2 * len(whole) > len(sets):
            shown = [found for found in whole if not _has_role(next(iter(found.values())), tokens)]
            templates = tuple(found for found in whole if found not in shown) if shown else ()
            yield _Column(index, values, tuple(shown or whole), templates)


def _has_role(capture: CaptureFile, tokens: Tokens) -> bool:
    """Whether a file is a dark, white or chart by its name or by those of its folders."""
    return any(t.role for t in tokens[capture.path]) or any(map(role_in, capture.folders))


def _follows(rows: Sequence[Sequence[Token]], one: int, other: int) -> bool:
    """Whether a part counts another: ``_001``, ``_002`` behind ``MB365UV``, ``MB450RB``; or a time."""
    pairs = {(row[other].text, row[one].text) for row in rows}
    values = {text for _, text in pairs}
    counts = all(row[one].kind in ("number", "time") for row in rows)
    return counts and len(values) == len(pairs) == len({text for text, _ in pairs})


# --- what decides -----------------------------------------------------------------------------


def _by_name(column: _Column, samples: Frames) -> tuple[str, str] | None:
    """Return the kind and the reason of a part that is known for bands by its name; None where it is not.

    Frames that clearly show other things overrule a name that may also count leaves.
    """
    texts, lower = column.values, {text.lower() for text in column.values}
    listed = f"{{band}}: {', '.join(texts)}"
    if lower <= LENSES and len(lower) > 2:
        return "sensor", f"{{sensor}}: {', '.join(texts)}, a lens each"
    pictures = lower <= IMAGES  # infrared, ultraviolet, xray: each by a camera of its own
    if lower <= COLOURS | IMAGES and len(lower & COLOURS) >= FEWEST and not pictures:
        return "band", listed
    if lower <= COLOURS | COLOUR_LETTERS and any(known <= lower for known in LETTERS):
        return "band", listed
    if are_elements(texts):
        return "band", listed
    codes = [CODE.fullmatch(text) for text in texts]
    if len(texts) > 2 and all(codes) and _are_spectral([float(m["number"]) for m in codes if m]):
        sure = all(m and len(m["before"]) > 1 for m in codes)
        if sure or _shows_one(column, samples) is not False:
            return "wavelength", "{wavelength}: the number between letters"
    if column.templates and _are_numbers(texts):
        exposures = EXPOSED.match(texts[0]) and _are_shots(column, samples)
        if not exposures and _shows_one(column, samples) is not False:
            return "wavelength", "{wavelength}: numbers that darks or whites have, too"
    counts = [COUNTED.fullmatch(text) for text in texts]
    words = {m["before"].lower() for m in counts if m}
    counted = len(texts) > 2 and all(counts) and len(words) == 1 and words <= BANDS
    if counted and (words <= NUMBERED_BANDS or _shows_one(column, samples) is not False):
        word = next(m["before"] for m in counts if m)
        return "band", f"{{band}}: {word!r} and a number, the same for every target"
    return None


def _by_pixels(
    column: _Column,
    cluster: Sequence[CaptureFile],
    sizes: Mapping[str, set[object]],
    samples: Frames,
    undecided_as_bands: bool,
) -> tuple[str, str] | None:
    """Return the kind and the reason of a part in which files of one scene differ; None where they do not."""
    if not _may_be_bands(column, cluster, sizes, samples):
        return None
    same = _shows_one(column, samples)
    if not same and not (undecided_as_bands and same is None):
        return None
    plain = all(re.fullmatch(r"[1-9]\d{2,3}", text) for text in column.values)
    kind = "wavelength" if plain and _are_spectral([float(t) for t in column.values]) else "band"
    return kind, f"{{{kind}}}: the files show the same details at the same place" if same else ""


def _may_be_bands(
    column: _Column,
    cluster: Sequence[CaptureFile],
    sizes: Mapping[str, set[object]],
    samples: Frames,
) -> bool:
    """Whether a part may name bands for all that is known: no photographs or lightings by their words, no files in
    colour, nothing that the files of another camera are called, too, no darks or whites among pictures, no shots of
    one scene by their numbers."""
    lower = {text.lower() for text in column.values}
    if lower & IMAGES or all(LIGHTS.fullmatch(text) for text in lower):
        return False
    own = {c.signature for c in cluster}
    if any(c.channels > 1 for c in cluster):
        return False
    if sum(not sizes[text] <= own for text in column.values) > 1:
        return False
    some = list(column.sets[0].values())
    if len({samples.shows_something(capture) for capture in some[:LOOKED_AT]}) > 1:
        return False
    if not all(re.search(r"\d$", text) for text in column.values):
        return True
    return len(some) > 2 and not _are_shots(column, samples)


def _are_shots(column: _Column, samples: Frames) -> bool:
    """Whether the files of the first set differ in brightness alone, as exposures and shots do."""
    some = list(column.sets[0].values())
    others = (some[len(some) // 2], some[-1])
    return all(samples.is_proportional(some[0], other) for other in others)


def _shows_something(one: dict[str, CaptureFile], samples: Frames) -> bool:
    """Whether the first, middle or last frame of a set has more structure than a dark or white."""
    some = list(one.values())
    return any(map(samples.shows_something, (some[0], some[len(some) // 2], some[-1])))


def _shows_one(column: _Column, samples: Frames) -> bool | None:
    """Return whether the files of a set show one object, and of no set several; None where no set decides it."""
    files = [[one[value] for value in column.values] for one in column.sets[:SETS]]
    found = {samples.show_the_same(some[:LOOKED_AT]) for some in files}
    return False if False in found else True if True in found else None


def _are_spectral(numbers: Sequence[float]) -> bool:
    """Whether numbers can be wavelengths: in range, each once, a few nm apart or more."""
    ordered = sorted(numbers)
    steps = [b - a for a, b in pairwise(ordered)]
    low, high = RANGE_NM
    return low <= ordered[0] <= ordered[-1] <= high and min(steps) >= LEAST_STEP_NM


def _are_numbers(texts: Sequence[str]) -> bool:
    """Whether values are wavelengths by their form: numbers behind the same letters.

    >>> _are_numbers(["W385", "W940"]), _are_numbers(["450", "550"]), _are_numbers(["101", "102"])
    (True, True, False)
    """
    found = [match for text in texts if (match := NUMBERED.fullmatch(text))]
    alike = len(found) == len(texts) and len({match["before"] for match in found}) == 1
    return alike and _are_spectral([float(match["number"]) for match in found])


def _marked(
    column: _Column, cluster: Sequence[CaptureFile], tokens: Tokens, kind: str, why: str
) -> Mapping[Path, tuple[Token, ...]]:
    """Return the names of a cluster with one part of another kind."""
    renamed = {}
    for capture in cluster:
        parts = list(tokens[capture.path])
        token = parts[column.index]
        code = NUMBERED.fullmatch(token.text)
        fields = {"before": "", "number": "", "after": ""}
        if kind == "wavelength":
            fields = code.groupdict() if code else {**fields, "number": token.text}
        parts[column.index] = replace(token, kind=kind, why=why, **fields)
        renamed[capture.path] = tuple(parts)
    return renamed
