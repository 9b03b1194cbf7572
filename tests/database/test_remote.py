"""Databases on a web server and in a store like S3: the same pixels, few requests, no wrong ones."""

import pickle
import random
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
import levkas.database.remote as database_remote
from levkas.cli import app as command
from levkas.core.cube import Band, Cube
from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.pixel_frames import find_map
from levkas.database.remote import RemoteRefused, place
from levkas.database.store import write_index
from levkas.database.validation import validate
from levkas.geometry.transforms import Affine

SHAPE = (150, 210)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    monkeypatch.setattr(database_remote, "PAUSE_S", 0.01)


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


@pytest.fixture(params=["s3", "web"])
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


def test_a_spectrum_costs_three_requests_at_most(remote, database):
    address, server = remote
    opened = levkas.open(address)
    assert len(server.requests) == 1
    layer = opened["icon 1é"]["vis"]
    assert len(server.requests) <= 3, server.requests
    server.requests.clear()
    spectrum = layer.isel(x=120, y=80).values
    assert len(server.requests) <= 3, server.requests
    here = levkas.open(database)["icon 1é"]["vis"].isel(x=120, y=80).values
    np.testing.assert_array_equal(spectrum, here)


@pytest.mark.slow
def test_all_layers_and_what_stands_beside_them_are_those_of_the_folder(remote, database):
    here, there = levkas.open(database)["icon 1é"], levkas.open(remote[0])["icon 1é"]
    assert list(here) == list(there) == ["d80", ("d80", "45-degree"), "vis"]
    for key in here:
        for one, other in ((here[key], there[key]), (here[key].flags, there[key].flags)):
            assert one.drop_vars("database").identical(other.drop_vars("database"))
    part = there["vis"].sel(band="550 nm")[10:20]
    assert part.sigma.equals(here["vis"].sel(band="550 nm")[10:20].sigma.assign_coords(part.coords))
    assert pickle.loads(pickle.dumps(part)).identical(part)
    points = np.array([[3.0, 4.0], [1000.0, 4.0]])
    mapped = find_map(remote[0], "icon 1é", "grid", "vis:550 nm")(points)
    np.testing.assert_array_equal(mapped, [[3.0, 4.0], [np.nan, np.nan]])


def test_a_database_without_zarr_is_read_from_its_tiffs(web, database, tmp_path):
    import shutil

    shutil.copytree(database / "objects", tmp_path / "db/objects")
    shutil.copy(database / "catalogue.csv", tmp_path / "db")
    address, _ = web(tmp_path / "db")
    here, there = (levkas.open(d)["icon 1é"]["vis"] for d in (database, address))
    np.testing.assert_array_equal(here.values, there.values)
    np.testing.assert_array_equal(here.flags.values, there.flags.values)


def test_validate_finds_every_file_whole_and_names_the_one_that_is_not(remote, database):
    address, server = remote
    report = validate(address)
    assert report.ok and report.manifest
    assert report.checked == validate(database).checked
    server.faults = lambda request: "changed" if "vis.flags.tif" in request else None
    found = validate(address).problems
    assert [p.code for p in found] == ["E_DAMAGED"]
    assert found[0].file == f"{address}/objects/icon 1é/icon 1é_vis.flags.tif"


def test_a_missing_shard_is_refused_and_never_read_as_empty(web, database, tmp_path):
    import shutil

    shutil.copytree(database, tmp_path / "db")
    (tmp_path / "db/zarr/icon 1é.zarr/vis/values/c/0/0/0").unlink()
    address, _ = web(tmp_path / "db")
    with pytest.raises(Refused, match="c/0/0/0"):
        levkas.open(address)["icon 1é"]["vis"][5, 5].values  # noqa: B018
    problems = validate(address).problems
    assert [(p.code, p.file.rpartition("/vis/")[2]) for p in problems] == [
        ("E_MISSING", "values/c/0/0/0")
    ]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["500", "cut", "short"])
def test_one_bad_answer_of_twenty_is_asked_for_again(remote, database, fault):
    address, server = remote
    rng = random.Random(fault)
    answers = []

    def sometimes(request):
        answers.append(fault if rng.random() < 0.05 else None)
        return answers[-1]

    server.faults = sometimes
    while answers.count(fault) < 3:
        there = levkas.open(address)["icon 1é"]
        for key, layer in levkas.open(database)["icon 1é"].items():
            np.testing.assert_array_equal(layer.values, there[key].values)
        assert validate(address).ok


@pytest.mark.parametrize("fault", ["500", "cut", "short", "changed"])
def test_a_store_that_always_answers_badly_is_refused_and_gives_no_pixel(remote, fault):
    address, server = remote
    layer = levkas.open(address)["icon 1é"]["vis"]
    server.faults = lambda request: fault
    with pytest.raises(Refused):
        layer.values  # noqa: B018 -- reads
    with pytest.raises(Refused):
        levkas.open(address)["icon 1é"]["vis"].values  # noqa: B018


@pytest.mark.slow
def test_a_file_that_is_replaced_while_it_is_read_is_refused(s3, database):
    for path in sorted(p for p in database.rglob("*") if p.is_file()):
        s3.client.upload_file(str(path), "museum", path.relative_to(database).as_posix())
    tiff = place("s3://museum") / "objects/icon 1é/icon 1é_vis.tif"
    with tiff.open("rb") as handle:
        handle.read(10)
        other = (database / "objects/icon 1é/icon 1é_vis.sigma.tif").read_bytes()
        s3.client.put_object(
            Bucket="museum", Key="objects/icon 1é/icon 1é_vis.tif",
            Body=other[:1].ljust(tiff.stat().st_size, b"x"),
        )  # fmt: skip
        handle.seek(1 << 20)
        with pytest.raises(RemoteRefused, match="replaced"):
            handle.read(10)


class Changing:
    """A file on a web server that knows no If-Match and serves another file from the second request on."""

    first, second = b"a" * (1 << 20), b"b" * (1 << 20)

    def __init__(self, headers, second=second):
        self.headers, self.second, self.requests = headers, second, 0

    def __call__(self, environ, start_response):
        self.requests += 1
        number = min(self.requests, 2) - 1
        data = (self.first, self.second)[number]
        start, _, stop = environ["HTTP_RANGE"].removeprefix("bytes=").partition("-")
        start, stop = (int(start), int(stop) + 1) if start else (len(data) - int(stop), len(data))
        stop = min(stop, len(data))
        headers = {name: values[number] for name, values in self.headers.items()}
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{len(data)}"
        headers["Content-Length"] = str(stop - start)
        start_response("206 Partial Content", list(headers.items()))
        return [data[start:stop]]


@pytest.mark.parametrize(
    "server",
    [
        Changing({"ETag": ('"1"', '"2"')}),
        Changing({"ETag": ('W/"1"', 'W/"2"')}),
        Changing({"Last-Modified": [f"Mon, 0{n} Jan 2024 00:00:00 GMT" for n in (1, 8)]}),
        Changing({}, b"b" * 1_000_000),
        Changing({}, b"b"),
    ],
    ids=["tag", "weak tag", "time", "size", "cut"],
)
@pytest.mark.parametrize("forget", [False, True])
def test_no_answer_of_a_server_without_if_match_is_of_another_file(serving, server, forget):
    server.requests = 0
    file = place(serving(server)) / "a.tif"
    assert file.stat().st_size == 1 << 20
    if forget:  # what was read first is no longer kept
        file.store._pieces.clear()
    with pytest.raises(RemoteRefused, match="replaced") as said:
        file.read_bytes()
    assert said.value.problems[0].fix == "Open the database again."
    with pytest.raises(RemoteRefused, match="replaced"):
        pickle.loads(pickle.dumps(file)).read_bytes()


def test_a_file_with_a_weak_tag_that_stays_is_read(serving):
    server = Changing({"ETag": ('W/"1"', 'W/"1"')}, Changing.first)
    assert (place(serving(server)) / "a.tif").read_bytes() == Changing.first


def test_a_server_that_sends_byte_by_byte_is_refused(serving, monkeypatch):
    def drip(environ, start_response):
        head = [("Content-Length", "131072"), ("Content-Range", "bytes 0-131071/10000000")]
        start_response("206 Partial Content", head)
        for _ in range(100):
            time.sleep(0.1)
            yield b"x"

    monkeypatch.setattr(database_remote, "TIMEOUT_S", 0.3)
    with pytest.raises(RemoteRefused, match=r"did not answer within 0\.3 s"):
        levkas.open(serving(drip))


def test_a_server_that_takes_too_long_for_all_answers_together_is_refused(
    web, database, monkeypatch
):
    address, server = web(database)
    monkeypatch.setattr(database_remote, "PATIENCE_S", 0.0)
    monkeypatch.setattr(database_remote, "SECONDS_A_REQUEST", 1e-6)
    monkeypatch.setattr(database_remote, "LEAST_RATE", 10**12)
    with pytest.raises(RemoteRefused, match="too slow"):
        levkas.open(address)["icon 1é"]["vis"].values  # noqa: B018 -- reads
    assert len(server.requests) == 1


@pytest.mark.parametrize("name", ["catalogue.csv", "manifest-sha256.txt"])
def test_a_catalogue_or_manifest_of_any_size_is_refused_before_it_is_read(serving, name):
    sent = []

    def endless(environ, start_response):
        if not environ["PATH_INFO"].endswith(name):
            start_response("404 Not Found", [])
            return []
        start, stop = map(int, environ["HTTP_RANGE"].removeprefix("bytes=").split("-"))
        sent.append(stop + 1 - start)
        headers = [("Content-Range", f"bytes {start}-{stop}/{10**12}")]
        start_response("206 Partial Content", [*headers, ("Content-Length", str(sent[-1]))])
        return [b"x" * sent[-1]]

    read = levkas.open if name == "catalogue.csv" else validate
    with pytest.raises(Refused, match=r"too large|at most"):
        read(serving(endless))
    assert sum(sent) < 1 << 20


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("s3://museum/nothing", "no database was found here"),
        ("s3://no-such-bucket/icons", "no database was found here"),
        ("http://127.0.0.1:9/icons", "cannot be reached"),
        ("ftp://example.org/icons", "not the address of a database"),
        ("https://ada:hunter2@example.org/icons", "must not contain a password"),
        ("https://example.org/icons?token=hunter2", "or a query"),
    ],
)
def test_an_address_without_a_database_is_refused_with_what_to_do(s3, address, why):
    found = CliRunner().invoke(command, ["validate", address])
    assert found.exit_code == 1
    assert why in found.output
    assert "hunter2" not in found.output
    with pytest.raises(Refused):
        levkas.open(address)


def test_keys_are_never_printed_not_even_those_that_are_refused(s3, serving, monkeypatch):
    def deny(environ, start_response):
        start_response("403 Forbidden", [("Content-Type", "application/xml")])
        return [b"<Error><AWSAccessKeyId>KEYKEYKEY</AWSAccessKeyId>SECRETSECRET</Error>"]

    monkeypatch.setenv("AWS_ENDPOINT_URL", serving(deny))
    for words in (["validate"], ["evaluate"], ["export", "--for", "envi"]):
        found = CliRunner().invoke(command, [words[0], "s3://museum/icons", *words[1:]])
        assert found.exit_code == 1
        assert "does not allow this" in found.output
        assert "AWS_ACCESS_KEY_ID" in found.output
        assert "KEYKEYKEY" not in found.output and "SECRETSECRET" not in found.output


def test_a_server_without_ranges_is_refused(serving, database):
    def plain(environ, start_response):
        path = database / environ["PATH_INFO"].lstrip("/").encode("latin-1").decode()
        start_response("200 OK" if path.is_file() else "404 Not Found", [])
        return [path.read_bytes()] if path.is_file() else []

    with pytest.raises(RemoteRefused, match="range requests"):
        levkas.open(serving(plain))


@pytest.mark.slow
def test_evaluate_export_and_map_read_an_address(remote, database, tmp_path):
    address, _ = remote
    run = CliRunner().invoke
    one, other = (run(command, ["evaluate", str(d), "--json"]) for d in (database, address))
    assert one.exit_code == other.exit_code == 0, other.output
    assert one.stdout == other.stdout
    for place_, out in ((database, "here"), (address, "there")):
        words = ["export", str(place_), "--for", "envi", "-o", str(tmp_path / out)]
        assert run(command, words).exit_code == 0
    files = sorted(p.relative_to(tmp_path / "here") for p in (tmp_path / "here").rglob("*"))
    assert files
    for file in files:
        if file.suffix and file.suffix != ".json":
            assert (tmp_path / "here" / file).read_bytes() == (
                tmp_path / "there" / file
            ).read_bytes()
    points = tmp_path / "points.csv"
    points.write_text("x,y\n1,2\n")
    words = ["icon 1é", "--to", "d80@45-degree", str(points)]
    mapped = run(command, ["map", address, words[0], words[3], *words[1:3]])
    assert mapped.stdout == "x,y\n1.000000,2.000000\n", mapped.output


def test_names_that_lead_elsewhere_are_refused(web, database, tmp_path):
    text = (database / "catalogue.csv").read_text().replace("icon 1é", "../../secret", 1)
    (tmp_path / "catalogue.csv").write_text(text)
    with pytest.raises(Refused, match="points to another folder"):
        levkas.open(web(tmp_path)[0])
