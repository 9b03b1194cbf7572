"""What words in names of files and folders mean, in the languages that studios use."""

from __future__ import annotations

import re
from dataclasses import dataclass

DARK = frozenset(
    [
        "dark",
        "darks",
        "darkframe",
        "darkref",
        "darkfield",
        "black",
        "blackref",
        "bias",
        "lenscap",
        "dunkel",
        "schwarz",
        "noir",
        "noire",
    ]
)
WHITE = frozenset(
    [
        "white",
        "whites",
        "whiteref",
        "whiteboard",
        "flat",
        "flats",
        "flatfield",
        "ff",
        "spectralon",
        "weiss",
        "blanc",
        "blanche",
    ]
)
CHARTS = {
    "colorchecker": "ColorChecker24",
    "colourchecker": "ColorChecker24",
    "macbeth": "ColorChecker24",
    "passport": "ColorChecker24",
    "ccsg": "ColorCheckerSG",
    "digitalsg": "ColorCheckerSG",
    "colorcheckersg": "ColorCheckerSG",
    "chart": "ColorChecker24",
}
"""Names of charts, and the reference that each most likely is."""
IMAGES = frozenset(
    [
        "photo",
        "photograph",
        "foto",
        "vis",
        "visible",
        "rgb",
        "color",
        "colour",
        "uv",
        "uvf",
        "uvl",
        "uvr",
        "ir",
        "irr",
        "irrgb",
        "irfc",
        "nir",
        "swir",
        "xray",
        "xr",
        "xrr",
        "radiograph",
        "radiography",
        "raking",
        "transmitted",
        "reflected",
        "fluorescence",
        "thermal",
        "reflectogram",
    ]
)
"""Kinds of technical photographs: in a name they tell the camera, not the object."""
SENSORS = frozenset(
    ["ccd", "cam", "camera", "sensor", "lens", "head", "chip", "cmos", "det", "detector"]
)
BANDS = frozenset(["band", "b", "ch", "chan", "channel", "filter", "f", "led"])
LIGHTS = re.compile(
    r"(?i)(\d+[-_ ]?(deg|degree|degrees|°)|.*(polari[sz]ed|polar|diffuse|raking|light|lamp|soft|cross|"
    r"proposed|d50|d65|led|halogen|tungsten|flash|left|right|specular).*|45)"
)
"""Names of lightings."""
MILD = re.compile(r"(?i).*(proposed|diffuse|soft|normal|default|standard|cross).*")
"""Of several lightings the one that is most likely the default."""
GENERIC = frozenset(
    [
        "raw",
        "raws",
        "frame",
        "frames",
        "image",
        "images",
        "img",
        "imgs",
        "data",
        "capture",
        "captures",
        "captured",
        "light",
        "lights",
        "shot",
        "shots",
        "tif",
        "tiff",
        "tiffs",
        "png",
        "jpg",
        "jpeg",
        "nef",
        "dng",
        "cr2",
        "cr3",
        "arw",
        "envi",
        "scans",
        "scan",
        "files",
        "original",
        "originals",
        "picture",
        "pictures",
        "object",
        "objects",
        "sample",
        "samples",
    ]
)
"""Folders that name nothing."""
PREFIXES = frozenset(
    [
        "img",
        "dsc",
        "dscf",
        "dscn",
        "dscn",
        "p",
        "mg",
        "im",
        "image",
        "frame",
        "capture",
        "scan",
        "shot",
        "pict",
        "cimg",
        "sam",
        "raw",
        "file",
        "pic",
    ]
)
"""What cameras write before their running number."""
MODELS = re.compile(
    r"(?i)(lctf|vis|nir|rgb|cam|msi|hsi|multispectral|hyperspectral|kinect|silios|d\d+$)"
)

_UNITS = "ms|us|µs|ns|s|sec|min"
_KINDS = {
    "time": re.compile(
        r"(19|20)\d\d[-.]?[01]\d[-.]?[0-3]\d([-T]?[0-2]\d[-.h]?[0-5]\d([-.m]?[0-5]\d)?)?(-\d+)?"
    ),
    "wavelength": re.compile(
        r"(?P<before>[A-Za-z]*?)(?P<number>\d{3,4}(?:\.\d+)?)(?P<after>[nN][mM])"
    ),
    "exposure": re.compile(
        rf"(?P<before>(?i:exp|exposure|t|it|int|e)?)(?P<number>\d+(?:\.\d+)?)(?P<after>(?i:{_UNITS}))"
    ),
    "number": re.compile(r"(?P<before>)(?P<number>\d+)(?P<after>)"),
    "numbered": re.compile(r"(?P<before>[A-Za-z][A-Za-z-]*?)(?P<number>\d+)(?P<after>)"),
}


@dataclass(frozen=True)
class Token:
    """One part of a name: its text, what stands before it, and what it looks like.

    `kind` is ``"time"``, ``"wavelength"``, ``"exposure"``, ``"number"``, ``"numbered"`` (letters and
    a number) or ``"word"``; `before`, `number` and `after` are the parts of one with a number.
    """

    text: str
    gap: str = ""
    kind: str = "word"
    before: str = ""
    number: str = ""
    after: str = ""

    @property
    def role(self) -> str:
        """``"dark"``, ``"white"``, ``"chart"`` or "", by the word itself."""
        return role_of(self.text)


def role_of(text: str) -> str:
    """Return ``"dark"``, ``"white"`` or ``"chart"`` where a single word says so, else "".

    Examples
    --------
    >>> role_of("Dark01"), role_of("whites"), role_of("macbeth"), role_of("darkness")
    ('dark', 'white', 'chart', '')
    """
    word = re.sub(r"[\d\W_]+$", "", text.lower())
    if word in DARK:
        return "dark"
    if word in WHITE:
        return "white"
    return "chart" if word in CHARTS else ""


def role_in(text: str) -> str:
    """Return the role of the first word of a name that has one: ``"white board"`` is a white."""
    roles = (role_of(word) for word in re.split(r"[\W_]+", text))
    return next((role for role in roles if role), "")


def tokens_of(stem: str) -> tuple[Token, ...]:
    """Take a name apart.

    Examples
    --------
    >>> [(t.text, t.kind) for t in tokens_of("d1_dark_100ms_2019-02-08-171146-0003")]
    [('d1', 'numbered'), ('dark', 'word'), ('100ms', 'exposure'), ('2019-02-08-171146-0003', 'time')]
    >>> [t.text for t in tokens_of("icon1-550nm") + tokens_of("4-22-22_right")]
    ['icon1', '550nm', '4-22-22', 'right']
    """
    tokens: list[Token] = []
    for gap, text in _split(stem, r"[_\s~+,()\[\]]+|\.(?!\d)|(?<!\d)\."):
        parts = _split(text, "-")
        told = [_typed(part, before) for before, part in parts]
        splits = len(parts) > 1 and _KINDS["time"].fullmatch(text) is None
        if splits and any(t.kind in ("wavelength", "exposure") or t.role for t in told):
            first = told[0]
            tokens.append(
                Token(first.text, gap, first.kind, first.before, first.number, first.after)
            )
            tokens += told[1:]
        else:
            tokens.append(_typed(text, gap))
    return tuple(tokens)


def _split(text: str, pattern: str) -> list[tuple[str, str]]:
    """Split into (what stands before, part), so that joining them all gives the text again."""
    found, at, gap = [], 0, ""
    for cut in re.finditer(pattern, text):
        if cut.start() > at:
            found.append((gap, text[at : cut.start()]))
            gap = ""
        gap, at = gap + cut.group(), cut.end()
    found.append((gap, text[at:]))
    return found


def _typed(text: str, gap: str) -> Token:
    for kind, pattern in _KINDS.items():
        told = pattern.fullmatch(text)
        if told is None:
            continue
        parts = told.groupdict()
        if kind == "wavelength" and not 200 <= float(parts["number"]) <= 3000:
            continue
        return Token(text, gap, kind, **{k: v or "" for k, v in parts.items()})
    return Token(text, gap)
