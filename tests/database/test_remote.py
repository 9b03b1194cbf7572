"""Databases on a web server and in a store like S3: the same pixels, few requests, no wrong ones."""

import pickle
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.cli import app as command
from levkas.core.cube import Band, Cube
from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.pixel_frames import find_map
from levkas.database.store import write_index
from levkas.database.validation import validate
from levkas.geometry.transforms import Affine

SHAPE = (150, 210)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """33 bands, so that a spectrum has three chunks, and a colour layer under two lightings."""
    root, rng = tmp_path_factory.mktemp("remote") / "icons", np.random.default_rng(4)
    entries = []
    for camera, setup, labels in (
        ("vis", "", [f"{w} nm" for w in range(400, 721, 10)]),
        ("d80", "", "RGB"),
        ("d80", "45-degree", "RGB"),
    ):
        values = rng.random((*SHAPE, len(labels)), np.float32)
        flags = rng.integers(0, 8, values.shape, np.uint8) * 2
        cube = Cube(values, flags, values / 100, tuple(Band(label) for label in labels))
        layer = Layer("icon 1é", camera, setup)
        entries.append(write_layer(root, layer, cube)[0])
        record = {
            "object": "icon 1é", "camera": camera, "setup": setup, "method": "levkas",
            "reference": {"camera": "vis", "band": "550 nm", "size": list(SHAPE[::-1])},
            "target": {"camera": camera, "setup": setup, "band": labels[0]},
            "verdict": {"decision": "accept", "reasons": []},
            "grid": {"size": list(SHAPE[::-1]), "transform": Affine.identity().to_dict()},
            "bands": {label: {"transform": Affine.identity().to_dict(),
                              "size": list(SHAPE[::-1])} for label in labels},
        }  # fmt: skip
        write_json(root / f"{entries[-1].layer.record}.json", record)
    write_index(root / "zarr/icon 1é.zarr")
    write_catalogue(root, entries)
    write_manifest(root)
    return root


@pytest.fixture(params=[pytest.param("s3", marks=pytest.mark.slow), "web"])
def remote(request, database):
    """The address of the database, and the application that serves it."""
    if request.param == "web":
        return request.getfixturevalue("web")(database)
    store = request.getfixturevalue("s3")
    for path in sorted(p for p in database.rglob("*") if p.is_file()):
        key = f"some/icons/{path.relative_to(database).as_posix()}"
        store.client.upload_file(str(path), "museum", key)
    store.requests.clear()
    return "s3://museum/some/icons", store


def test_a_spectrum_costs_few_requests_and_few_bytes(remote, database):
    address, server = remote
    layer = levkas.open(address)["icon 1é"]["vis"]
    assert len(server.requests) <= 16, server.requests
    server.requests.clear()
    spectrum = layer.isel(x=120, y=80).values
    assert len(server.requests) <= 8, server.requests
    here = levkas.open(database)["icon 1é"]["vis"].isel(x=120, y=80).values
    np.testing.assert_array_equal(spectrum, here)


@pytest.mark.slow
def test_all_layers_and_what_stands_beside_them_are_those_of_the_folder(remote, database):
    here, there = levkas.open(database)["icon 1é"], levkas.open(remote[0])["icon 1é"]
    assert list(here) == list(there) == ["d80", ("d80", "45-degree"), "vis"]
    for key in here:
        both = here[key].drop_vars("database"), there[key].drop_vars("database")
        assert both[0].identical(both[1])
        flags = here[key].levkas.flags, there[key].levkas.flags
        np.testing.assert_array_equal(*(one.values for one in flags))
    part = there["vis"].sel(band="550 nm")[10:20]
    sigma = here["vis"].sel(band="550 nm")[10:20].levkas.sigma
    np.testing.assert_array_equal(part.levkas.sigma.values, sigma.values)
    assert pickle.loads(pickle.dumps(part)).identical(part)
    points = np.array([[3.0, 4.0], [1000.0, 4.0]])
    mapped = find_map(remote[0], "icon 1é", "grid", "vis:550 nm")(points)
    np.testing.assert_array_equal(mapped, [[3.0, 4.0], [np.nan, np.nan]])


def test_a_database_without_zarr_is_read_from_its_tiffs(web, database, tmp_path):
    shutil.copytree(database / "objects", tmp_path / "db/objects")
    shutil.copy(database / "catalogue.csv", tmp_path / "db")
    address, _ = web(tmp_path / "db")
    here, there = (levkas.open(d)["icon 1é"]["vis"] for d in (database, address))
    np.testing.assert_array_equal(here.values, there.values)
    np.testing.assert_array_equal(here.levkas.flags.values, there.levkas.flags.values)


def test_validate_finds_every_file_whole_and_names_the_one_that_is_not(remote, database):
    address, server = remote
    report = validate(address)
    assert report.ok
    assert report.checked == validate(database).checked
    server.faults = lambda request: (
        "changed" if request.startswith("GET") and "vis.flags.tif" in request else None
    )
    found = validate(address).problems
    assert [p.code for p in found] == ["E_DAMAGED"]
    assert found[0].file == f"{address}/objects/icon 1é/icon 1é_vis.flags.tif"


def test_a_missing_shard_is_refused_and_never_read_as_empty(web, database, tmp_path):
    shutil.copytree(database, tmp_path / "db")
    (tmp_path / "db/zarr/icon 1é.zarr/vis/values/c/0/0/0").unlink()
    address, _ = web(tmp_path / "db")
    with pytest.raises(Refused) as refused:
        levkas.open(address)["icon 1é"]["vis"][5, 5].values  # noqa: B018
    assert refused.value.problems[0].file.endswith("values/c/0/0/0")
    problems = validate(address).problems
    assert [(p.code, p.file.rpartition("/vis/")[2]) for p in problems] == [
        ("E_MISSING", "values/c/0/0/0")
    ]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["500", "cut", "short", "changed"])
def test_a_store_that_always_answers_badly_is_refused_and_gives_no_pixel(remote, fault):
    address, server = remote
    layer = levkas.open(address)["icon 1é"]["vis"]
    server.faults = lambda request: fault
    with pytest.raises(Refused):
        layer.values  # noqa: B018 -- reads
    with pytest.raises(Refused):
        levkas.open(address)["icon 1é"]["vis"].values  # noqa: B018


@pytest.mark.parametrize("name", ["catalogue.csv", "manifest-sha256.txt"])
def test_a_catalogue_or_manifest_of_any_size_is_refused_before_it_is_read(serving, name):
    sent = []

    def endless(environ, start_response):
        if not environ["PATH_INFO"].endswith(name):
            start_response("404 Not Found", [])
            return []
        if environ["REQUEST_METHOD"] != "HEAD":
            sent.append(environ["PATH_INFO"])
        start_response("200 OK", [("Content-Length", str(10**12)), ("Accept-Ranges", "bytes")])
        return []

    if name == "catalogue.csv":
        with pytest.raises(Refused):
            levkas.open(serving(endless))
    else:
        assert not validate(serving(endless)).ok
    assert not sent


@pytest.mark.slow
@pytest.mark.parametrize(
    "address",
    [
        "s3://museum/nothing",
        "s3://no-such-bucket/icons",
        "ftp://example.org/icons",
        "https://ada:hunter2@example.org/icons",
        "https://example.org/icons?token=hunter2",
    ],
)
def test_an_address_without_a_database_is_refused_and_no_password_shown(s3, address):
    found = CliRunner().invoke(command, ["validate", address])
    assert found.exit_code == 1 and "hunter2" not in found.output
    with pytest.raises(Refused):
        levkas.open(address)


@pytest.mark.slow
def test_keys_are_never_printed_not_even_those_that_are_refused(s3, serving, monkeypatch):
    def deny(environ, start_response):
        start_response("403 Forbidden", [("Content-Type", "application/xml")])
        return [b"<Error><AWSAccessKeyId>KEYKEYKEY</AWSAccessKeyId>SECRETSECRET</Error>"]

    monkeypatch.setenv("AWS_ENDPOINT_URL", serving(deny))
    for words in (["validate"], ["evaluate"], ["export", "--for", "envi"]):
        found = CliRunner().invoke(command, [words[0], "s3://museum/icons", *words[1:]])
        assert found.exit_code == 1
        assert "KEYKEYKEY" not in found.output and "SECRETSECRET" not in found.output


def test_names_that_lead_elsewhere_are_refused(web, database, tmp_path):
    text = (database / "catalogue.csv").read_text().replace("icon 1é", "../../secret", 1)
    (tmp_path / "catalogue.csv").write_text(text)
    with pytest.raises(Refused):
        levkas.open(web(tmp_path)[0])
