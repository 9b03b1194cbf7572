"""Bands in names: the one part in which files of one object differ, by what it is; what names do not decide is asked."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from levkas.campaign.discovery.patterns import natural
from levkas.campaign.guess.listing import CaptureFile
from levkas.campaign.guess.pixels import Samples
from levkas.campaign.guess.words import (
    BANDS,
    COLOUR_LETTERS,
    COLOURS,
    IMAGES,
    LENSES,
    LIGHTS,
    NUMBERED_BANDS,
    PREFIXES,
    SHELL,
    Token,
    are_elements,
    joined,
    role_in,
    tokens_of,
)

Tokens = dict[Path, tuple[Token, ...]]
Place = tuple[tuple[str, ...], str]
"""Names of the folders, and the other parts of a name: what files of one set of bands have in common."""

LETTERS = ({"r", "g", "b"}, {"red", "green", "blue"})
"""Sets of values of which all must be there for single letters to be colours: r and v are recto and verso, too."""
CODE = re.compile(r"[A-Za-z]{2,3}(?P<number>\d{3,4})[A-Za-z]{1,3}")
"""``MB450RB`` of a MegaVision: a wavelength between letters; ``450r`` may be a leaf."""
NUMBERED = re.compile(r"(?P<before>[A-Za-z]{0,3})(?P<number>[1-9]\d{2,3})(?P<after>[A-Za-z]{0,3})")
"""``W385``, ``450``, ``450N``: a wavelength where several targets, or darks and whites, have the same numbers."""
COUNTED = re.compile(r"(?P<before>[A-Za-z]+)(?P<number>\d{1,3})(?P<after>[A-Za-z]?)")
RANGE_NM, LEAST_STEP_NM = (300.0, 2600.0), 4.0
STEP = 1.1
"""Times as high a level, from one number to the next, with which they may be exposures."""
MOST_VALUES, FEWEST = 64, 2
"""Values of one part of the names; nobody has more bands in files of their own whose names have no unit."""


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


def mark_bands(
    captures: Sequence[CaptureFile], tokens: Tokens, samples: Samples, *, undecided_as_bands: bool
) -> tuple[Tokens, list[Question]]:
    """Mark the part of names that is a band or a wavelength.

    Returns
    -------
    tokens : dict of path to tokens
        The part is of kind ``"wavelength"``, ``"band"`` or ``"sensor"``, with the reason; where `undecided_as_bands`, what
        nothing decides, too.
    questions : list of Question
        What nothing decides.
    """
    tokens = _with_shells(captures, tokens)
    sizes: dict[str, set[object]] = defaultdict(set)
    for capture in captures:
        for text in (*capture.folders, *(t.text for t in tokens[capture.path])):
            sizes[text].add(capture.signature)
    marked, known = dict(tokens), dict[tuple[str, ...], tuple[str, str]]()
    undecided: list[tuple[list[CaptureFile], list[_Column]]] = []
    for cluster in _clusters(captures, tokens):
        columns = list(_columns(cluster, tokens))
        found = next(((c, kind) for c in columns if (kind := _by_name(c, samples))), None)
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
        elif not any(_has_role(c, tokens) or _names_band(c, tokens) for c in cluster) and (
            likely := next((c for c in columns if _may_be_bands(c, cluster, sizes, samples)), None)
        ):
            files = tuple(c for one in likely.sets for c in one.values())
            questions.append(Question(files, likely.values))
            if undecided_as_bands:
                role = "wavelength" if _are_numbers(likely.values) else "band"
                marked |= _marked(likely, cluster, tokens, role, "")
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


def _names_band(capture: CaptureFile, tokens: Tokens) -> bool:
    """Whether the name of a file, or of a folder of its own, has a wavelength: then no other part is a band."""
    parts = [t for name in capture.folders for t in tokens_of(name)]
    return any(t.kind == "wavelength" for t in (*tokens[capture.path], *parts))


def _follows(rows: Sequence[Sequence[Token]], one: int, other: int) -> bool:
    """Whether a part counts another: ``_001``, ``_002`` behind ``MB365UV``, ``MB450RB``; or a time."""
    pairs = {(row[other].text, row[one].text) for row in rows}
    values = {text for _, text in pairs}
    counts = all(row[one].kind in ("number", "time") for row in rows)
    return counts and len(values) == len(pairs) == len({text for text, _ in pairs})


# --- what decides -----------------------------------------------------------------------------


def _by_name(column: _Column, samples: Samples) -> tuple[str, str] | None:
    """Return the kind and the reason of a part that is known for bands by its name; None where it is not."""
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
    numbers = [float(m["number"]) for m in codes if m]
    if len(texts) > 2 and all(codes) and _are_spectral(numbers):
        return "wavelength", "{wavelength}: the number between letters"
    several = len(texts) > 2 and len(column.sets) > 1
    if (
        (column.templates or several)
        and _are_numbers(texts)
        and not _are_exposures(column, samples)
    ):
        return "wavelength", "{wavelength}: numbers that several targets have"
    if len(texts) > 2 and (word := _counted_word(texts)) in NUMBERED_BANDS:
        return "band", f"{{band}}: {word!r} and a number, the same for every target"
    return None


def _counted_word(texts: Sequence[str]) -> str:
    """Return the word that numbers follow in all texts, lower case; "" for several, or none.

    >>> _counted_word(["F1s", "F2s"]), _counted_word(["F1", "G1"])
    ('f', '')
    """
    words = {m["before"].lower() if (m := COUNTED.fullmatch(text)) else "" for text in texts}
    return words.pop() if len(words) == 1 else ""


def _may_be_bands(
    column: _Column,
    cluster: Sequence[CaptureFile],
    sizes: Mapping[str, set[object]],
    samples: Samples,
) -> bool:
    """Whether a part may name bands for all that is known: no photographs or lightings by their words, no files in
    colour, nothing that the files of another camera are called, too, no shots by their numbers."""
    lower = {text.lower() for text in column.values}
    if lower & IMAGES or all(LIGHTS.fullmatch(text) for text in lower):
        return False
    own = {c.signature for c in cluster}
    several, word = len(column.values) > 2, _counted_word(column.values)
    if several and word in BANDS:
        return True
    if any(c.channels > 1 for c in cluster):
        return False
    if sum(not sizes[text] <= own for text in column.values) > 1:
        return False
    if not all(re.search(r"\d$", text) for text in column.values):
        return True
    if not all(text.isdecimal() for text in column.values) and word not in PREFIXES:
        return several
    alike = not samples.difference(list(column.sets[0].values()))
    return several and (_are_numbers(column.values) or not alike)


def _are_exposures(column: _Column, samples: Samples) -> bool:
    """Whether the levels of frames follow the numbers in their names, as those of exposures do."""
    files = column.sets[0]
    found = [samples.of(files[text]) for text in sorted(files, key=natural)]
    levels = [statistics.mean for statistics in found if statistics is not None]
    return len(levels) == len(found) and all(b > STEP * a for a, b in pairwise(levels))


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
