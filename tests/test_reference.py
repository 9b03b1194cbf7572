"""Public names have complete docstrings."""

import builtins
import doctest
import functools
import inspect
import re
from pathlib import Path

import pytest

import levkas

ROOT = Path(__file__).resolve().parents[1]
NAMES = [name for name in levkas.__all__ if name != "__version__"]
#: Algorithms of a publication: the docstring has its DOI.
PUBLISHED = {
    "register", "warp", "calibrate", "structural_similarity", "noise_variance", "Sensor",
    "Polynomial", "Homography",
}  # fmt: skip
SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.M)
#: A name that an entry of a section begins with.
ENTRY = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*) : (.+)$|^(\*{2}\w+)$", re.M)
UNITS = re.compile(
    r"\b(px|nm|s|counts|electrons|dB|mm|degrees|reflectance|relative|unit|bool|bits|uint8)\b"
    r"|−1 … 1|0–255",
    re.I,
)
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def sections(text):
    """Return title → text of a docstring in NumPy's form."""
    parts = SECTION.split(text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def entries(section):
    """Return name → type and description of the entries of a section."""
    found, last = {}, []
    for line in section.splitlines():
        named = ENTRY.match(line)
        if named:
            last = [name.lstrip("*") for name in (named[1] or named[3]).split(", ")]
            found.update(dict.fromkeys(last, named[2] or ""))
        else:
            for name in last:
                found[name] += " " + line.strip()
    return found


def parameters(thing):
    """Return the names of what a function, or the call of a class, takes."""
    if inspect.isclass(thing) and issubclass(thing, builtins.int):  # an enumeration
        return []
    return [name for name in inspect.signature(thing).parameters if name != "self"]


def faults(name, thing):
    """Return what the docstring of a public name lacks."""
    text = inspect.getdoc(thing) or ""
    parts = sections(text)
    described = entries(parts.get("Parameters", "")) | entries(parts.get("Attributes", ""))
    missing = [f"parameter {p}" for p in parameters(thing) if p not in described]
    for entry, words in (described | entries(parts.get("Returns", ""))).items():
        if "ndarray" in words and not re.search(
            r"\([\w′, 1-9+·]+\)|any shape|like `|same shape", words
        ):
            missing.append(f"shape of {entry}")
        if re.search(r"ndarray|float", words) and not UNITS.search(words):
            missing.append(f"unit of {entry}")
    if inspect.isfunction(thing):
        returns = inspect.signature(thing).return_annotation
        if returns not in (None, "None") and not {"Returns", "Yields"} & parts.keys():
            missing.append("what it returns")
    if "Raises" not in parts and "raises nothing" not in text:
        missing.append("errors")
    raised = re.findall(r"^(?:levkas\.\S+\.|numpy\.\S+\.)?(\w+)$", parts.get("Raises", ""), re.M)
    missing += [f"exception {one}" for one in raised if one not in exceptions()]
    examples = doctest.DocTestParser().get_examples(parts.get("Examples", ""))
    if not any(example.want for example in examples):
        missing.append("an example with its result")
    if name in PUBLISHED and not re.search(r"doi:10\.\d{4}/", text):
        missing.append("DOI")
    return missing


@functools.cache
def exceptions():
    """Return the names of the exceptions of Python, NumPy and Levkas."""
    source = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "src").rglob("*.py"))
    own = re.findall(r"^class (\w+)\(\w*(?:Refused|Exception|Error|Invalid)\w*\)", source, re.M)
    return {*vars(builtins), "LinAlgError", *own}


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_has_parameters_shapes_units_errors_and_an_example(name):
    assert faults(name, getattr(levkas, name)) == []


def test_what_a_docstring_lacks_is_found():
    def blur(image, width: float = 1.0) -> float:
        """Blur an image.

        Parameters
        ----------
        image : ndarray
            The pixels.

        Raises
        ------
        BlurRefused
        """

    assert faults("warp", blur) == [
        "parameter width",
        "shape of image",
        "unit of image",
        "what it returns",
        "exception BlurRefused",
        "an example with its result",
        "DOI",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_sources_of_a_docstring_are_in_the_bibliography_with_the_same_doi(name):
    text = inspect.getdoc(getattr(levkas, name))
    records = (ROOT / "docs/references.bib").read_text(encoding="utf-8").split("\n@")
    known = {re.search(r"\{(\w+),", record)[1]: record for record in records}
    cited = re.findall(r"\[([a-z]+\d{4})\]_", text)
    assert set(cited) <= known.keys()
    for doi in re.findall(r"doi:(10\.[\w./()-]*\w)", text):
        assert any(f"doi = {{{doi}}}" in known[key] for key in cited), doi


def test_doctests_of_the_package_are_collected(pytestconfig):
    assert pytestconfig.getoption("doctestmodules")
    assert "src" in pytestconfig.getini("testpaths")
