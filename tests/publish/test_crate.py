import json
import re
import shutil
import warnings
from urllib.parse import unquote

import pytest

from levkas.core.json_safe import to_json
from levkas.core.problems import Refused
from levkas.database.manifest import write_manifest
from levkas.publish.crate import NAME

from .crate_rules import PREVIEW, ask_validator, check_crate

STEPS = {
    "object": "icon1",
    "levkas": "0.0.9",
    "libraries": {"numpy": "2.0"},
    "steps": [
        {
            "camera": "vis",
            "setup": "",
            "stage": "calibrate",
            "code": "abc",
            "parameters": {"cameras.vis.bits": 12},
            "inputs": {"raw/vis/icon 1.tif": "ab" * 32},
            "products": {"objects/icon1/icon1_vis.tif": "cd" * 32},
        }
    ],
}


@pytest.fixture(scope="module")
def published(_database, publish, tmp_path_factory):
    database = tmp_path_factory.mktemp("crate") / "database"
    shutil.copytree(_database, database)
    (database / "objects/icon1/provenance.json").write_text(json.dumps(STEPS))
    (database / "objects/icon1/a name %20 ü.txt").write_text("x")
    write_manifest(database)
    return publish(database)


@pytest.fixture
def folder(published, tmp_path):
    return shutil.copytree(published, tmp_path / published.name)


def graph_of(folder):
    return {e["@id"]: e for e in json.loads((folder / NAME).read_text())["@graph"]}


def test_every_step_is_an_action_with_program_parameters_and_hashed_inputs(folder):
    entities = graph_of(folder)
    action = entities["#icon1-vis-calibrate"]
    assert action["@type"] == "CreateAction"
    assert entities[action["instrument"]["@id"]]["version"] == "0.0.9"
    assert action["result"] == {"@id": "objects/icon1/icon1_vis.tif"}
    objects = [entities[o["@id"]] for o in action["object"]]
    assert {"raw/vis/icon 1.tif"} == {o["name"] for o in objects if o.get("sha256") == "ab" * 32}
    assert ("cameras.vis.bits", "12") in {(o["name"], o.get("value")) for o in objects}


def test_files_bear_size_and_hash_and_their_names_are_encoded(folder):
    entities = graph_of(folder)
    assert entities["objects/icon1/a%20name%20%2520%20%C3%BC.txt"]["contentSize"] == "1"
    tiff = entities["objects/icon1/icon1_vis.tif"]
    assert len(tiff["sha256"]) == 64 and tiff["encodingFormat"] == "image/tiff"


def test_people_licence_and_dates_are_those_of_the_campaign(folder):
    root = graph_of(folder)["./"]
    assert root["datePublished"] == "2019-06-30"
    assert root["license"] == {"@id": "https://creativecommons.org/licenses/by/4.0/"}
    assert graph_of(folder)[root["author"]["@id"]]["familyName"] == "Painter"


def test_the_library_reads_the_crate_again(folder):
    from rocrate.rocrate import ROCrate

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        crate = ROCrate(folder)
    assert crate.name == "Icons of Levkas"
    assert len([e for e in crate.data_entities if e.type == "File"]) > 20


def test_the_rules_are_kept(folder):
    assert check_crate(folder) == []


def without(key):
    return lambda g: g["./"].pop(key)


BREAKS = {
    "license": without("license"),
    "datePublished": without("datePublished"),
    "its date is no date": lambda g: g["./"].update(datePublished="June"),
    "refers to nothing": lambda g: g["./"].update(publisher={"@id": "#nobody"}),
    "not described": lambda g: (
        g.pop("catalogue.csv")
        and g["./"].update(hasPart=[p for p in g["./"]["hasPart"] if p["@id"] != "catalogue.csv"])
    ),
    "no hasPart": lambda g: g["./"].update(
        hasPart=[p for p in g["./"]["hasPart"] if p["@id"] != "catalogue.csv"]
    ),
    "no such file": lambda g: g.update({"x.tif": {"@id": "x.tif", "@type": "File"}}),
    "another size": lambda g: g["catalogue.csv"].update(contentSize="3"),
    "stands inside": lambda g: g["./"].update(author={"@type": "Person", "name": "A"}),
    "conformsTo": lambda g: g[NAME].pop("conformsTo"),
    "conformsTo is a text": lambda g: g[NAME].update(conformsTo="https://w3id.org/ro/crate/1.1"),
    "publisher": lambda g: g["./"].update(publisher={"@id": "catalogue.csv"}),
    "no File and no Dataset": lambda g: g["./"]["hasPart"].append(g["./"]["license"]),
    "thumbnail": lambda g: g["./"].update(thumbnail=g["./"]["license"]),
    "is no URI": lambda g: g.update({"#a b": {"@id": "#a b", "@type": "Thing"}}),
    "web site": lambda g: g.update({"#w": {"@id": "#w", "@type": "WebSite"}}),
    "no @type": lambda g: g["catalogue.csv"].pop("@type"),
    "preview": lambda g: g[PREVIEW].pop("about"),
    "copy": lambda g: g["./"].update(name="Another name"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_each_broken_rule_is_found(folder, name):
    document = json.loads((folder / NAME).read_text())
    graph = {e["@id"]: e for e in document["@graph"]}
    BREAKS[name](graph)
    document["@graph"] = list(graph.values())
    (folder / NAME).write_text(to_json(document))
    problems = check_crate(folder)
    assert problems and all(p.code == "E_CRATE" and p.field for p in problems)


def test_the_page_of_the_crate_leads_to_every_file_and_tells_every_step(folder):
    page = (folder / PREVIEW).read_text(encoding="utf-8")
    assert "http-equiv" in page and "default-src 'none'" in page
    links = {unquote(link) for link in re.findall(r'href="([^"#]+)"', page) if ":" not in link}
    assert {link for link in links if not (folder / link).is_file()} == set()
    files = {unquote(i) for i, e in graph_of(folder).items() if e["@type"] == "File"}
    assert files <= links and len(files) > 20
    body = page.partition("</head>")[2]
    row = body.partition("Calibrated on native pixels")[2].partition("</tr>")[0]
    assert "Levkas 0.0.9" in row and "icon1_vis.tif" in row


def test_two_entities_of_one_id_are_found(folder):
    document = json.loads((folder / NAME).read_text())
    document["@graph"].append(document["@graph"][-1])
    (folder / NAME).write_text(to_json(document))
    assert "two entities" in str(check_crate(folder)[0])


@pytest.mark.slow
def test_roc_validator_finds_nothing_that_is_required_but_a_broken_rule(folder, tmp_path):
    assert ask_validator(folder, tmp_path / "report.json") == []
    document = json.loads((folder / NAME).read_text())
    for entity in document["@graph"]:
        if entity["@type"] == "SoftwareApplication":
            entity.pop("url")
    (folder / NAME).write_text(to_json(document))
    found = ask_validator(folder, tmp_path / "report.json")
    assert any("MUST have a `url`" in one for one in found)


@pytest.mark.slow
def test_a_provenance_that_describes_no_steps_is_refused(database, publish):
    path = database / "objects/icon1/provenance.json"
    for record in ({"steps": [{}]}, {"steps": 3}, {"steps": ["a"]}):
        path.write_text(json.dumps(record))
        write_manifest(database)
        with pytest.raises(Refused, match="does not describe the steps") as said:
            publish(database, iiif=False)
        assert said.value.problems[0].file == str(path)
