"""A campaign is published from its database: what `--check` says of it is what `publish` does."""

import pytest

from levkas.building import build
from levkas.core.problems import Refused
from levkas.publish.run import check, publish


def refusals(folder):
    try:
        list(publish(folder, iiif=False))
    except Refused as error:
        return {p.code for p in error.problems}
    return set()


@pytest.mark.slow
def test_the_check_of_a_campaign_refuses_what_publish_refuses(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one"])
    path = folder / "campaign.toml"
    text = path.read_text()
    facts = 'creator = "Ada"\nlicence = "CC0-1.0"\n'
    whole = text.replace("[campaign]\n", f"[campaign]\n{facts}", 1)
    expected = {whole: False, whole + "\n[registration]\nreject = 7\n": True, text: True}
    path.write_text(whole)
    assert not check(folder).ok and refusals(folder)  # it was never built
    list(build(folder))
    for toml, wrong in expected.items():
        path.write_text(toml)
        found = {p.code for p in check(folder).problems}
        assert refusals(folder) <= found and bool(found) == bool(refusals(folder)) == wrong
