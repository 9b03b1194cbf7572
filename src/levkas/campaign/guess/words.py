"""Words in names of files and folders, in the languages that studios use, and names taken apart."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

from levkas.campaign.chart_names import CHARTS


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


DARK = _words(
    "dark darks darkframe darkframes darkref darkreference darkfield darkcurrent black blackref blackframe bias "
    "offset lenscap dunkel dunkelbild dunkelbilder dunkelfeld dunkelstrom dunkelreferenz schwarz schwarzbild "
    "schwarzreferenz schwarzabgleich schwarzaufnahme schwarzwert dunkelaufnahme dunkelaufnahmen dunkelabgleich "
    "dunkelkorrektur noir noire obscurite buio campooscuro camponero donkerbeeld nolight lightsoff lightoff unlit"
)
WHITE = _words(
    "white whites whiteref whitereference whiteboard whitecard whitefield whiteframe whitebalance flat flats "
    "flatfield flatframe ff brightfield spectralon fluorilon ptfe weiss weissbild weissbilder weissabgleich "
    "weissreferenz weisskarte weisstafel weissstandard weissfeld weissaufnahme weisskorrektur weisswert hell "
    "hellbild hellbilder hellfeld hellaufnahme hellreferenz hellabgleich blanc blanche campochiaro campobianco campopiatto witbeeld"
)
"""Not the bare colours of languages in which paintings bear them (Madonna nera, Bianca): pixels show those."""
IMAGES = _words("""
    photo photograph foto infrared ultraviolet vis visible optical rgb color colour uv uvf uvl uvr ir irr irrgb irfc nir swir xray xr
    xrr radiograph radiography raking transmitted reflected fluorescence thermal reflectogram
""")
"""Kinds of technical photographs: in a name they stand for the camera, not the object."""
SENSORS = _words("ccd cam camera sensor lens head chip cmos det detector")
BANDS = _words("band b ch chan channel filter f led")
NUMBERED_BANDS = _words("band chan channel filter led")
"""Of these the words before a number that name bands for certain: F1 and b2 may be leaves."""
COLOURS = _words("""
    blue green red yellow orange amber cyan violet magenta purple royalblue indigo infrared ultraviolet rededge nir
    swir uva uvb uvc gre reg pan panchromatic rot grün gruen blau gelb rouge vert bleu jaune rosso verde blu giallo
""")
COLOUR_LETTERS = _words("r g b n i w c m y k a o v u l p re ir uv")
LENSES = _words("gre red reg nir")
"""The four lenses of a Parrot Sequoia; its short word for green is nobody else's."""
LIGHTS = re.compile(
    r"(?i)(\d+[-_ ]?(deg|degree|degrees|°)|.*(polari[sz]ed|polar|diffuse|raking|light|lamp|soft|cross|"
    r"proposed|d50|d65|led|halogen|tungsten|flash|left|right|specular).*|45)"
)
"""Names of lightings."""
MILD = re.compile(r"(?i).*(proposed|diffuse|soft|normal|default|standard|cross).*")
"""Of several lightings the one that is most likely the default."""
GENERIC = _words("""
    raw raws frame frames image images img imgs data capture captures captured light lights shot shots tif
    tiff tiffs png jpg jpeg nef dng cr2 cr3 arw envi scans scan files original originals picture pictures object objects
    sample samples
""")
"""Folders that name nothing."""
PREFIXES = _words(
    "img dsc dscf dscn p mg im image frame capture scan shot pict cimg sam raw file pic"
)
"""Prefixes that cameras write before their running number."""
ELEMENTS = _words("""
    Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Rb Sr Y Zr Nb Mo Ru Rh Pd Ag Cd In Sn Sb Te
    I Cs Ba La Ce Nd Sm Eu Gd Tb Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi Th U
""")
"""Symbols of those that X-ray fluorescence finds in paint."""
SHELL = r"[KLM]([abαβ]\d?)?"
"""Of the electrons whose lines were fitted: ``K``, ``La1``."""
_ELEMENT = re.compile(rf"(?P<symbol>[A-Z][a-z]?)([-_ ]?{SHELL})?")
SG = ("digitalsg", "sg140", "checkersg")
"""Parts of longer names of the chart with 140 patches."""
PLACE = re.compile(
    r"(?i:(?P<a>r(?:ow)?[-_ ]?)(?P<row>\d+)(?P<b>[-_ ,]*c(?:ol(?:umn)?)?[-_ ]?)(?P<column>\d+)"
    r"|(?P<c>(?:grid|tile)[@_ -]?)(?P<down>\d+)(?P<d>[_ ,x-]+)(?P<across>\d+))"
)
"""A row and a column, with the text around their numbers."""
TARGET, OBJECT = "{target}", "{object}"
TYPED = ("time", "wavelength", "exposure", "band", "sensor")
"""Kinds of tokens with a unit or a date, and those that name a band or a sensor."""

_KINDS = {
    "time": re.compile(
        r"(19|20)\d\d[-.]?[01]\d[-.]?[0-3]\d([-T]?[0-2]\d[-.h]?[0-5]\d([-.m]?[0-5]\d)?)?(-\d+)?"
    ),
    "wavelength": re.compile(
        r"(?P<before>[A-Za-z]*?)(?P<number>\d{3,4}(?:\.\d+)?)(?P<after>[nN][mM])"
    ),
    "exposure": re.compile(
        r"(?P<before>(?i:exp|exposure|t|it|int|e)?)(?P<number>\d+(?:\.\d+)?)"
        r"(?P<after>(?i:ms|us|µs|ns|s|sec|min))"
    ),
    "number": re.compile(r"(?P<before>)(?P<number>\d+)(?P<after>)"),
    "numbered": re.compile(r"(?P<before>[A-Za-z][A-Za-z-]*?)(?P<number>\d+)(?P<after>)"),
}


@dataclass(frozen=True)
class Token:
    """One part of a name: its text, the separators before it, and its kind.

    `kind` is ``"time"``, ``"wavelength"``, ``"exposure"``, ``"number"``, ``"numbered"`` (letters and
    a number), ``"target"``, ``"object"``, ``"tile"`` (the pattern of a place) or ``"word"``; ``"band"`` or ``"sensor"`` where `guess.band_names` found
    `why` it is one. `before`, `number` and `after` are the parts of one with a number.
    """

    text: str
    gap: str = ""
    kind: str = "word"
    before: str = ""
    number: str = ""
    after: str = ""
    why: str = ""

    @property
    def role(self) -> str:
        """``"dark"``, ``"white"``, ``"chart"`` or "", by the word itself."""
        return role_of(self.text)

    @property
    def word(self) -> str:
        """The text beside its numbers; "" for what cameras write before theirs."""
        words = {"word": self.text, "target": self.text, "object": self.text}
        words |= {"numbered": self.before, "wavelength": self.before if self.why else ""}
        text = words.get(self.kind, "")
        return "" if text.lower() in PREFIXES else text

    @property
    def names_sensor(self) -> bool:
        """Whether it names one of several sensors, such as ``ccd1``."""
        numbered = self.kind == "numbered" and self.before.lower() in SENSORS
        return numbered or self.kind == "sensor"

    @property
    def names_channel(self) -> bool:
        """Whether it names a sensor or a band, such as ``ccd1`` or ``band3``."""
        return self.kind == "numbered" and self.before.lower() in SENSORS | BANDS


def plain(text: str) -> str:
    """Return the letters and digits of a name, lower case and without accents.

    >>> plain("Weißbild"), plain("Color-Checker SG")
    ('weissbild', 'colorcheckersg')
    """
    apart = unicodedata.normalize("NFKD", text.casefold())
    return "".join(c for c in apart if c.isalnum())


def chart_in(text: str) -> str:
    """Return the reference of the chart with this name: ``ColorChecker24``, …; "" for none.

    A long word may go on: ``ColorCheckerClassicMini``.

    >>> chart_in("Color Checker"), chart_in("colorchecker digital sg"), chart_in("artist")
    ('ColorChecker24', 'ColorCheckerSG', '')
    """
    word = plain(text)
    known = CHARTS.get(word.rstrip("0123456789")) or next(
        (chart for name, chart in CHARTS.items() if len(name) > 6 and word.startswith(name)), ""
    )
    return "ColorCheckerSG" if known and any(part in word for part in SG) else known


@cache  # names of twenty thousand files have the same few hundred words
def role_of(text: str) -> str:
    """Return ``"dark"``, ``"white"`` or ``"chart"`` where a single word says so, else "".

    Examples
    --------
    >>> role_of("Dark01"), role_of("whites"), role_of("macbeth"), role_of("darkness")
    ('dark', 'white', 'chart', '')
    """
    word = plain(text).rstrip("0123456789")
    if word in DARK:
        return "dark"
    if word in WHITE:
        return "white"
    return "chart" if chart_in(text) else ""


def are_elements(texts: Sequence[str]) -> bool:
    """Whether at least three texts, two in three of all, name elements, with or without a line of theirs.

    Single letters may be anything: half of the names have to be longer.

    >>> are_elements(["Pb-L", "Hg L", "Fe_Ka", "chisq"]), are_elements(["R", "G", "B"]), are_elements(["K", "S", "P"])
    (True, False, False)
    """
    found = [m for text in texts if (m := _ELEMENT.fullmatch(text)) and m["symbol"] in ELEMENTS]
    longer = sum(len(m.group()) > 1 for m in found)
    return len(found) >= max(3, 2 * len(texts) / 3) and 2 * longer >= len(found)


@cache
def role_in(text: str) -> str:
    """Return the role of the first word, or two, of a name that has one: ``"white board"`` is a white."""
    words = re.split(r"[\W_]+", text)
    pairs = [" ".join(pair) for pair in pairwise(words)]
    return next((role for role in map(role_of, [*words, *pairs]) if role), "")


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
        parts[0] = (gap + parts[0][0], parts[0][1])
        apart = [_typed(part, before) for before, part in parts]
        splits = len(parts) > 1 and _KINDS["time"].fullmatch(text) is None
        if splits and any(t.kind in ("wavelength", "exposure") or t.role for t in apart):
            tokens += apart
        else:
            tokens.append(_typed(text, gap))
    return tuple(_with_pairs(tokens))


def _with_pairs(tokens: Sequence[Token]) -> list[Token]:
    """Make one of two words that have a role together alone: ``Color Checker``, ``lens cap``."""
    made: list[Token] = []
    for token in tokens:
        last = made[-1] if made else None
        pair = Token(last.text + token.gap + token.text, last.gap) if last else token
        words = last is not None and last.kind == token.kind == "word"
        if words and last and pair.role and not (last.role or token.role):
            made[-1] = pair
        else:
            made.append(token)
    return made


def joined(tokens: Sequence[Token]) -> str:
    """Return the original text of some tokens, without the separators before the first."""
    text = "".join(t.gap + t.text for t in tokens)
    return text[len(tokens[0].gap) :] if tokens else ""


def _split(text: str, pattern: str) -> list[tuple[str, str]]:
    """Split into (separators before, part), so that joining them all gives the text again."""
    found, at, gap = [], 0, ""
    for cut in re.finditer(pattern, text):
        if cut.start() > at:
            found.append((gap, text[at : cut.start()]))
            gap = ""
        gap, at = gap + cut.group(), cut.end()
    found.append((gap, text[at:]))
    return found


@cache
def _typed(text: str, gap: str) -> Token:
    for kind, pattern in _KINDS.items():
        found = pattern.fullmatch(text)
        if found is None:
            continue
        parts = found.groupdict()
        if kind == "wavelength" and not 200 <= float(parts["number"]) <= 3000:
            continue
        return Token(text, gap, kind, **{k: v or "" for k, v in parts.items()})
    return Token(text, gap)
