"""ro-crate-metadata.json: what the library reads, what the validator finds, what the steps say."""

import json
import shutil
import subprocess
import sys
import warnings
from urllib.parse import unquote

import pytest

from levkas.core.json_safe import to_json
from levkas.core.problems import Refused
from levkas.database.manifest import write_manifest
from levkas.publish.crate import NAME

STEP = {
    "camera": "vis",
    "setup": "",
    "stage": "calibrate",
    "code": "abc",
    "parameters": {"cameras.vis.bits": 12},
    "inputs": {"raw/vis/icon 1.tif": "ab" * 32},
    "products": {"objects/icon1/icon1_vis.tif": "cd" * 32},
}
RECORD = {"object": "icon1", "levkas": "0.0.9", "libraries": {"numpy": "2.0"}, "steps": [STEP]}


@pytest.fixture(scope="module")
def published(_database, publish, tmp_path_factory):
    database = tmp_path_factory.mktemp("crate") / "database"
    shutil.copytree(_database, database)
    (database / "objects/icon1/provenance.json").write_text(json.dumps(RECORD))
    (database / "objects/icon1/a name %20 ü.txt").write_text("x")
    write_manifest(database)
    return publish(database)


@pytest.fixture(scope="module")
def graph(published):
    entities = json.loads((published / NAME).read_text())["@graph"]
    found = {entity["@id"]: entity for entity in entities}
    assert len(found) == len(entities), "no two entities of one id"
    return found


def listed(value):
    return value if isinstance(value, list) else [value]


def test_every_reference_leads_to_an_entity_and_every_file_hangs_below_the_root(graph, published):
    referred = [
        part["@id"]
        for entity in graph.values()
        for value in entity.values()
        for part in listed(value)
        if isinstance(part, dict)
    ]
    inside = [i for i in referred if not i.startswith(("http://", "https://", "mailto:"))]
    assert inside and set(inside) <= graph.keys()
    below, waiting = set(), ["./"]
    while waiting:
        for part in listed(graph[waiting.pop()].get("hasPart", [])):
            below.add(part["@id"])
            waiting.append(part["@id"])
    files = {i for i, entity in graph.items() if entity["@type"] == "File"}
    assert files <= below and len(files) > 20
    for name in files:
        path = published / unquote(name)
        assert graph[name]["contentSize"] == str(path.stat().st_size)
    assert "objects/icon1/a%20name%20%2520%20%C3%BC.txt" in files
    tiff = graph["objects/icon1/icon1_vis.tif"]
    assert len(tiff["sha256"]) == 64 and tiff["encodingFormat"] == "image/tiff"


def test_a_step_is_an_action_with_its_program_hashed_inputs_and_products(graph):
    action = graph["#icon1-vis-calibrate"]
    assert action["@type"] == "CreateAction"
    assert graph[action["instrument"]["@id"]]["version"] == "0.0.9"
    assert action["result"] == {"@id": "objects/icon1/icon1_vis.tif"}
    (given,) = (graph[o["@id"]] for o in listed(action["object"]))
    assert (given["name"], given["sha256"]) == ("raw/vis/icon 1.tif", "ab" * 32)


def test_people_licence_and_dates_are_those_of_the_campaign(graph):
    root = graph["./"]
    assert root["datePublished"] == "2019-06-30"
    assert root["license"] == {"@id": "https://creativecommons.org/licenses/by/4.0/"}
    author = graph[root["author"]["@id"]]
    assert (author["@type"], author["familyName"]) == ("Person", "Painter")


def test_the_library_reads_the_crate_again(published):
    from rocrate.rocrate import ROCrate

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        crate = ROCrate(published)
    assert crate.name == "Icons of Levkas"
    assert len([e for e in crate.data_entities if e.type == "File"]) > 20


OFFLINE = """
import importlib.resources, requests
from requests.adapters import HTTPAdapter

CONTEXT = (importlib.resources.files("rocrate") / "data/ro-crate.jsonld").read_bytes()

def send(self, request, **options):
    answer = requests.Response()
    answer.request, answer.url = request, request.url
    known = request.url.endswith("/ro/crate/1.3/context")
    answer.status_code, answer._content = (200, CONTEXT) if known else (404, b"")
    answer.headers["Content-Type"] = "application/ld+json"
    return answer

HTTPAdapter.send = send
from rocrate_validator.cli import cli
cli()
"""
"""The program of roc-validator, with the context of RO-Crate 1.3 that `rocrate` brings along in the network's place."""
PROFILES = (("ro-crate-1.3",), ("process-run-crate", "-nh"))
"""Of roc-validator; its Process Run Crate is asked alone, for it inherits a rule that RO-Crate is 1.1."""


def ask_validator(folder, report):
    """Ask roc-validator, in a process of its own and without a network, for what is required."""
    found = []
    for profile, *alone in PROFILES:
        command = [sys.executable, "-c", OFFLINE, "-y", "validate", "--no-paging", "--no-cache"]
        command += ["-l", "required", "-f", "json", "-o", str(report), "-p", profile, *alone]
        done = subprocess.run([*command, str(folder)], capture_output=True, text=True, check=False)
        assert report.is_file(), done.stdout + done.stderr
        read = json.loads(report.read_text(encoding="utf-8"))
        assert sum(read["statistics"]["total_checks_by_severity"].values()) > 3
        found += [(one["check"]["identifier"], one["message"]) for one in read["issues"]]
        report.unlink()
    return found


@pytest.mark.slow
def test_roc_validator_finds_nothing_that_is_required_but_a_broken_rule(published, tmp_path):
    folder = shutil.copytree(published, tmp_path / published.name)
    assert ask_validator(folder, tmp_path / "report.json") == []
    document = json.loads((folder / NAME).read_text())
    for entity in document["@graph"]:
        if entity["@type"] == "SoftwareApplication":
            entity.pop("url")
    (folder / NAME).write_text(to_json(document))
    assert ask_validator(folder, tmp_path / "report.json")


@pytest.mark.parametrize("steps", [[{}], 3, ["a"]])
def test_a_provenance_that_describes_no_steps_is_refused(database, publish, steps):
    path = database / "objects/icon1/provenance.json"
    path.write_text(json.dumps({"steps": steps}))
    write_manifest(database)
    with pytest.raises(Refused) as said:
        publish(database, iiif=False)
    (problem,) = said.value.problems
    assert (problem.code, problem.file) == ("E_UNREADABLE", str(path))
