"""Public names are documented: an example with its result, errors, a source with its DOI that the bibliography has."""

import doctest
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
RETURNS = re.compile(r"\b(returns?|yields?|find|result|whether)\b", re.I)
RAISES = re.compile(r"\b(raises?|refused?)\b", re.I)


def lacks(name, thing):
    """Return what the docstring of a public name lacks, in prose or in sections of NumPy's form."""
    text = inspect.getdoc(thing) or ""
    returns = inspect.isfunction(thing) and inspect.signature(thing).return_annotation
    examples = doctest.DocTestParser().get_examples(text)
    has = {
        "what it returns": returns in (False, None, "None") or RETURNS.search(text),
        "errors": RAISES.search(text),
        "an example with its result": any(example.want for example in examples),
        "DOI": name not in PUBLISHED or re.search(r"doi:10\.\d{4}/", text),
    }
    return [what for what, there in has.items() if not there]


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_says_what_it_returns_raises_and_shows(name):
    thing = getattr(levkas, name)
    assert lacks(name, thing) == []
    text = inspect.getdoc(thing)
    records = (ROOT / "docs/references.bib").read_text(encoding="utf-8").split("\n@")
    known = {re.search(r"\{(\w+),", record)[1]: record for record in records}
    cited = re.findall(r"\[([a-z]+\d{4})\]_", text)
    assert set(cited) <= known.keys()
    for doi in re.findall(r"doi:(10\.[\w./()-]*\w)", text):
        assert any(f"doi = {{{doi}}}" in known[key] for key in cited), doi


def test_what_a_docstring_lacks_is_found():
    def blur(image) -> float:
        """Blur an image."""

    assert lacks("warp", blur) == ["what it returns", "errors", "an example with its result", "DOI"]
