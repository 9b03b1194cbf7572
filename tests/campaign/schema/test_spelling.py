import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.campaign.schema.tables import Creator, PublicationKeys
from levkas.campaign.schema.toml import to_toml

KEYS = st.text(min_size=1, max_size=8)
PLAIN = (
    st.text(min_size=1).filter(lambda t: not any("\ud800" <= c <= "\udfff" for c in t))
    | st.integers(-(2**40), 2**40)
    | st.floats(allow_nan=False)
    | st.booleans()
)
LISTS = st.lists(PLAIN, min_size=1, max_size=3)
INNER = st.dictionaries(KEYS, PLAIN | LISTS, min_size=1, max_size=3)


@given(st.dictionaries(KEYS, PLAIN | LISTS | INNER | st.dictionaries(KEYS, INNER, min_size=1)))
def test_what_is_spelled_is_what_is_read(record):
    assert tomllib.loads(to_toml(record)) == record


def test_an_orcid_with_a_wrong_check_digit_is_refused():
    for text in ("https://orcid.org/0000-0002-1825-0097", "0000-0002-1694-233x"):
        creator = Creator(name="A", orcid=text)
        assert creator.orcid == text[-19:].upper()
    with pytest.raises(ValueError):
        Creator(name="A", orcid="0000-0002-1825-0098")


def test_a_doi_is_taken_without_its_resolver():
    keys = PublicationKeys(doi="https://doi.org/10.5281/zenodo.1")
    assert keys.doi == "10.5281/zenodo.1"
    with pytest.raises(ValueError):
        PublicationKeys(doi="zenodo.1")
