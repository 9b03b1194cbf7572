import os
import unicodedata

from levkas.campaign.discovery import file_index as module
from levkas.campaign.discovery.file_index import (
    FolderListings,
    find_files,
)


def touch(root, *names):
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def names(root, *patterns, **more):
    return [f.path.relative_to(root).as_posix() for f in find_files(root, patterns, **more)]


def test_every_folder_is_listed_once_for_many_patterns(tmp_path, monkeypatch):
    touch(tmp_path, *(f"raw/t{t}/{s}_{n}.tif" for t in range(3) for s in "abc" for n in range(2)))
    listed = []
    scan = os.scandir
    monkeypatch.setattr(module.os, "scandir", lambda folder: listed.append(folder) or scan(folder))
    folders = FolderListings()
    for sensor in "abc":
        pattern = f"raw/{{target}}/{sensor}_{{shot}}.tif"
        assert len(find_files(tmp_path, [pattern], folders=folders)) == 6
    assert len(listed) == len(set(listed)) == 4


def test_hidden_files_and_what_we_wrote_are_never_found(tmp_path):
    touch(tmp_path, "x/a.tif", "x/.a.tif", ".git/a.tif", "x/a.tif.partial-0123abcd")
    touch(tmp_path, "database/objects/a/a.tif", "database/a.tif")
    touch(
        tmp_path,
        "elsewhere/objects/a.tif",
        "elsewhere/catalogue.csv",
        "campaign.toml",
        "edits.toml",
    )
    folders = FolderListings(never=[tmp_path / "database"])
    assert names(tmp_path, "**/{target}.*", folders=folders) == ["x/a.tif"]


def test_a_link_that_leads_back_is_not_followed_for_ever(tmp_path):
    touch(tmp_path, "a/x.tif")
    (tmp_path / "a" / "again").symlink_to(tmp_path)
    assert names(tmp_path, "**/{target}.tif") == ["a/x.tif"]
    assert len(find_files(tmp_path, ["a/again/a/{target}.tif"])) == 1


def test_accents_that_a_file_system_took_apart_are_put_together(tmp_path):
    touch(tmp_path, unicodedata.normalize("NFD", "Église.tif"))
    (found,) = find_files(tmp_path, ["{target}.tif"], known={"target": ("Église",)})
    assert found.target == "Église"


def test_a_header_and_its_data_are_one_file(tmp_path):
    touch(tmp_path, "a.hdr", "a.raw", "b.raw.hdr", "b.raw", "c.hdr", "c", "d.raw")
    assert names(tmp_path, "{target}*") == ["a.hdr", "b.raw.hdr", "c.hdr", "d.raw"]
    assert names(tmp_path, "{target}.raw") == ["a.raw", "b.raw", "d.raw"]
