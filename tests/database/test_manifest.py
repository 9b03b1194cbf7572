import subprocess

import pytest

from levkas.core.digests import hash_file
from levkas.database.manifest import NAME, Listed, _to_bytes, read_manifest, write_manifest


@pytest.fixture
def folder(tmp_path):
    for name, text in (("b.txt", "two"), ("a/ü 50%.txt", "one"), ("a/b/c.csv", "x,y\n")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_what_is_written_is_what_is_read(folder):
    written = write_manifest(folder)
    read = read_manifest(folder / NAME)
    assert read.files == written.files
    assert (read.bytes, read.problems) == (10, ())
    assert list(read.files) == ["a/b/c.csv", "a/ü 50%.txt", "b.txt"]
    assert read.files["b.txt"].sha256 == hash_file(folder / "b.txt")
    assert read.files["b.txt"].size == 3


def test_the_same_folder_gives_the_same_bytes_and_is_not_written_twice(folder):
    write_manifest(folder, threads=1)
    first, stamp = (folder / NAME).read_bytes(), (folder / NAME).stat().st_mtime_ns
    write_manifest(folder, threads=3)
    assert (folder / NAME).read_bytes() == first
    assert (folder / NAME).stat().st_mtime_ns == stamp


def test_sha256sum_reads_the_manifest(tmp_path):
    (tmp_path / "a.txt").write_text("one")
    write_manifest(tmp_path)
    command = ["sha256sum", "--check", "--strict", NAME]
    try:
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("sha256sum is not installed")
    assert done.returncode == 0


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x"])
def test_a_line_that_leaves_the_folder_is_a_damage(tmp_path, name):
    (tmp_path / NAME).write_bytes(_to_bytes({name: Listed(name, "ab" * 32, 1)}, 1))
    manifest = read_manifest(tmp_path / NAME)
    assert manifest.files == {}
    assert manifest.problems[0].code == "E_DAMAGED"


def test_any_flipped_bit_of_a_manifest_is_seen(folder):
    write_manifest(folder)
    data = (folder / NAME).read_bytes()
    for bit in range(0, 8 * len(data), 29):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        (folder / NAME).write_bytes(changed)
        assert read_manifest(folder / NAME).problems, f"bit {bit}"
