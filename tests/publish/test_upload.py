"""A publication sent to a store like S3: whole, gone on with, and nothing of others replaced."""

import json
import shutil

import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app as command
from levkas.core.digests import hash_file
from levkas.core.problems import Refused
from levkas.database.manifest import NAME, write_manifest
from levkas.database.remote import RemoteRefused
from levkas.database.validation import validate
from levkas.publish.publication import PublishRefused
from levkas.publish.upload import UploadTarget

ADDRESS = "s3://museum/icons/2019"


@pytest.fixture
def folder(tmp_path):
    """A small folder with a manifest, names that addresses have other meanings for among them."""
    for name in ("catalogue.txt", "a/b c é.csv", "a/100% #1 ?x+y.json", "a/b.html", "z.bin"):
        path = tmp_path / "published" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode() * 1000)
    write_manifest(tmp_path / "published")
    return tmp_path / "published"


def sent(s3):
    """Name of every object in the bucket → its size."""
    found = s3.client.list_objects_v2(Bucket="museum").get("Contents", [])
    return {one["Key"]: one["Size"] for one in found}


def puts(s3):
    """Names that were written since, in order."""
    return [r.partition("/museum/icons/2019/")[2] for r in s3.requests if r.startswith("PUT")]


def test_a_publication_is_sent_opened_and_found_whole(s3, database, tmp_path):
    words = ["publish", str(database), "--no-iiif", "--to", ADDRESS, "-o", str(tmp_path / "out")]
    found = CliRunner().invoke(command, [*words, "--json"])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["address"] == ADDRESS
    files = {p.relative_to(tmp_path / "out").as_posix(): p.stat().st_size
             for p in (tmp_path / "out").rglob("*") if p.is_file()}  # fmt: skip
    assert sent(s3) == {f"icons/2019/{name}": size for name, size in files.items()}
    assert puts(s3)[-1] == NAME
    assert validate(ADDRESS).ok
    here, there = levkas.open(tmp_path / "out"), levkas.open(ADDRESS)
    assert there["icon1"]["vis"].identical(here["icon1"]["vis"])
    page = s3.client.head_object(Bucket="museum", Key="icons/2019/index.html")
    assert page["ContentType"] == "text/html"
    s3.requests.clear()
    found = CliRunner().invoke(command, words)
    assert found.exit_code == 0, found.output
    assert f"Sent, with its manifest last: {ADDRESS}" in found.output
    assert puts(s3) == []


def test_every_object_bears_its_checksum_and_its_type(s3, folder):
    list(UploadTarget(ADDRESS).send(folder))
    for name in sent(s3):
        facts = s3.client.head_object(Bucket="museum", Key=name, ChecksumMode="ENABLED")
        path = folder / name.removeprefix("icons/2019/")
        assert facts["Metadata"] == {"levkas-sha256": hash_file(path)}
        body = s3.client.get_object(Bucket="museum", Key=name)["Body"].read()
        assert body == path.read_bytes()
    kinds = {"a/b.html": "text/html", "z.bin": "application/octet-stream"}
    for name, kind in kinds.items():
        facts = s3.client.head_object(Bucket="museum", Key=f"icons/2019/{name}")
        assert facts["ContentType"] == kind


def test_an_interrupted_upload_goes_on_where_it_was(s3, folder):
    upload = UploadTarget(ADDRESS).send(folder)
    next(upload), next(upload)
    upload.close()
    there = {name.removeprefix("icons/2019/") for name in sent(s3)}
    assert NAME not in there and len(there) >= 2
    s3.requests.clear()
    steps = list(UploadTarget(ADDRESS).send(folder))
    assert steps[-1] == (NAME, 6, 6)
    assert not there & set(puts(s3))
    assert validate(ADDRESS).ok


def test_a_store_that_fails_leaves_no_manifest_and_the_next_upload_ends(s3, folder):
    s3.faults = lambda request: "500" if request.startswith("PUT") and "z.bin" in request else None
    with pytest.raises(RemoteRefused, match="error 500"):
        list(UploadTarget(ADDRESS).send(folder))
    assert f"icons/2019/{NAME}" not in sent(s3)
    s3.faults = lambda request: None
    list(UploadTarget(ADDRESS).send(folder))
    assert validate(ADDRESS).ok


def test_another_version_replaces_what_changed_and_takes_away_what_is_gone(s3, folder):
    list(UploadTarget(ADDRESS).send(folder))
    (folder / "z.bin").unlink()
    (folder / "a/b.html").write_text("new</html>")
    write_manifest(folder)
    s3.requests.clear()
    list(UploadTarget(ADDRESS).send(folder))
    assert puts(s3) == ["a/b.html", NAME]
    assert "icons/2019/z.bin" not in sent(s3)
    assert validate(ADDRESS).ok


@pytest.mark.parametrize("name", ["notes.txt", "catalogue.txt", NAME])
def test_what_levkas_did_not_send_is_never_replaced(s3, folder, name):
    s3.client.put_object(Bucket="museum", Key=f"icons/2019/{name}", Body=b"of somebody else")
    with pytest.raises(PublishRefused, match=f"did not send, the first: {name}"):
        UploadTarget(ADDRESS)
    assert sent(s3) == {f"icons/2019/{name}": 16}
    s3.client.put_object(Bucket="museum", Key="icons/2019-notes.txt", Body=b"beside")
    s3.client.delete_object(Bucket="museum", Key=f"icons/2019/{name}")
    list(UploadTarget(ADDRESS).send(folder))
    assert sent(s3)["icons/2019-notes.txt"] == 6


def test_the_publication_of_other_objects_is_not_replaced(s3, database, publish):
    list(UploadTarget(ADDRESS, ["icon1"]).send(publish(database, iiif=False)))
    with pytest.raises(PublishRefused, match="it holds the publication of icon1, icon2"):
        UploadTarget(ADDRESS, ["icon9"])


def test_a_file_that_changed_since_is_not_sent(s3, folder):
    (folder / "z.bin").write_bytes(b"changed")
    with pytest.raises(PublishRefused, match=r"z\.bin: it has changed"):
        list(UploadTarget(ADDRESS).send(folder))
    assert f"icons/2019/{NAME}" not in sent(s3)


@pytest.mark.parametrize("address", ["https://example.org/icons", "s3://no-such-bucket/icons"])
def test_an_address_that_nothing_can_be_sent_to_is_refused(s3, database, tmp_path, address):
    words = ["publish", str(database), "--no-iiif", "-o", str(tmp_path / "out"), "--to", address]
    found = CliRunner().invoke(command, words)
    assert found.exit_code == 1
    assert "E_" in found.output and address in found.output
    assert "SECRETSECRET" not in found.output


def test_a_folder_without_a_whole_manifest_is_not_sent(s3, folder):
    shutil.copy(folder / "z.bin", folder / NAME)
    with pytest.raises(Refused):
        list(UploadTarget(ADDRESS).send(folder))
    assert sent(s3) == {}
