import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.campaign.schema.toml import LARGEST_FILE, TomlRefused, read_toml


def refused(folder, text):
    path = folder / "x.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(TomlRefused) as caught:
        read_toml(path)
    return caught.value.problems[0]


@pytest.mark.parametrize(
    "text",
    [
        ".".join("a" * 20_000) + " = 1",
        "x = { " + ".".join("a" * 20_000) + " = 1 }",
        "[" + ".".join("a" * 20_000) + "]",
        '["a".' + ".".join("b" * 20_000) + "]",
        "x = " + "[" * 5000 + "]" * 5000,
        "x = " + "{a=" * 5000 + "1" + "}" * 5000,
        "a" * 70_000 + " = 1",
        '"' + "a" * 70_000 + '" = 1',
        "x = " + "9" * 70_000,
        'x = ["""a"""", { ' + ".".join("a" * 20_000) + ' = 1 }, "b"]',
        "# x\ny = '''\n''' # '\nx." + ".".join("a" * 20_000) + " = 1",
    ],
    ids=lambda text: text[:12],
)
def test_what_is_built_to_exhaust_the_parser_is_refused_before_it_starts(tmp_path, text):
    assert refused(tmp_path, text).code == "E_SIZE"


def test_a_file_of_a_mebibyte_is_read_no_further(tmp_path):
    assert refused(tmp_path, "#" * (LARGEST_FILE + 1)).expected == "at most 1 MiB"
    (tmp_path / "y.toml").write_text("#" * LARGEST_FILE)
    assert read_toml(tmp_path / "y.toml") == {}


@pytest.mark.parametrize(
    "text", ["a =", "= 1", 'a = "x', "a = 1\na = 2", b"\xff\xfe", "a = 1e", '"""' * 99_999]
)
def test_what_is_no_toml_names_the_file(tmp_path, text):
    assert refused(tmp_path, text).file.endswith("x.toml")


@given(st.text(alphabet="ab.=[]{}\"'\\#,\n 1", max_size=60))
def test_every_text_is_read_as_tomllib_reads_it_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("toml") / "x.toml"
    path.write_text(text, encoding="utf-8", newline="")
    try:
        expected = tomllib.loads(text)
    except ValueError:
        expected = None
    try:
        assert read_toml(path) == expected
    except TomlRefused as refusal:
        assert expected is None, refusal


@pytest.mark.parametrize(
    ("text", "found", "fix"),
    [
        ("[cameras.a]\n[cameras.b]\n[cameras.a]\n", "[cameras.a]", "a name of its own"),
        ("a = 1\na = 2\n", "a = 2", "each key once"),
        ("title = „Köln“\n", "title = „Köln“", "straight quotes"),
        ('files = "raw\\photo\\{target}.tif"\n', "raw\\photo", "with /"),
        ("title = Köln\n", "title = Köln", "text in quotes"),
    ],
)
def test_a_line_that_is_no_toml_is_shown_with_what_to_do(tmp_path, text, found, fix):
    path = tmp_path / "campaign.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TomlRefused) as caught:
        read_toml(path)
    (problem,) = caught.value.problems
    assert found in problem.found.partition("): ")[2] and fix in problem.fix
