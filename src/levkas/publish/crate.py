"""ro-crate-metadata.json: the folder described by RO-Crate 1.3 as a Process Run Crate: every file and every step of its making.

Entities are plain JSON-LD; the tests read them with the `rocrate` package. Dates are those of the captures and of
the publication, never the clock's.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from levkas import __version__
from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.core.text import read_json
from levkas.publish.declarations import BUILT, CAMPAIGN, EDITS, FOLDER
from levkas.publish.metadata import DOI, ORCID, Person, PublicationFacts
from levkas.publish.publication import PROVENANCE, PublishRefused, describe_dataset

if TYPE_CHECKING:
    from collections.abc import Mapping

    from levkas.publish.publication import Publication


NAME = "ro-crate-metadata.json"
PROFILE = "https://w3id.org/ro/crate/1.3"
PROCESS = "https://w3id.org/ro/wfrun/process/0.5"
"""Profile of crates that record what was run, on what, by which version (Leo et al. 2024, 10.1371/journal.pone.0309210)."""
TERMS = {"sha256": "https://w3id.org/ro/terms/workflow-run#sha256"}
"""Words that RO-Crate has not, and where they are explained."""
WHOLE = {
    "zarr": "the layers of an object as Zarr v3",
    "iiif": "manifests and tiles for viewers of the IIIF Presentation and Image API 3",
    "viewer": "pictures and spectra that the pages show",
}
"""Folders of many small files, and what each is as a whole."""
FORMATS = {
    ".tif": "image/tiff",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".csv": "text/csv",
    ".json": "application/json",
    ".html": "text/html",
    ".md": "text/markdown",
    ".txt": "text/plain",
    ".toml": "application/toml",
    ".cff": "application/yaml",
}
KINDS = {
    ".flags.tif": "flags of every pixel and band",
    ".sigma.tif": "one standard deviation of every value's random part",
    ".matches.csv": "matches of the registration",
    f"{FOLDER}/{CAMPAIGN}": "what the campaign declares: put beside the raw frames, `levkas build` gives the database",
    f"{FOLDER}/{EDITS}": "corrections by hand",
    f"{FOLDER}/{BUILT}": "SHA-256 of every file of the database that was built from the declarations",
    "manifest-sha256.txt": "SHA-256 and size of every file",
    "catalogue.csv": "all layers: bands, size, sampling, quantity, verdict, hash",
    "splits.csv": "which objects to learn from, to choose with and to test on",
    "database.toml": "what the campaign says of the database",
    "object.toml": "what is known of the object",
    PROVENANCE: "inputs, parameters and products of every stage, with their hashes",
    "camera.json": "what was measured of the camera",
    "sensitivity.csv": "spectral sensitivities: wavelength in nm, a column a channel",
    "spd.csv": "spectrum of the light: wavelength in nm, power",
    "report.html": "report as a page",
    "gamut.png": "CIELAB gamut of the layers, three views",
    "gamut.csv": "CIELAB gamut of the layers, by cells",
    "index.html": "pages to look at the database",
    "README.md": "what this is, how to cite and to read it, what the numbers mean",
    "README.html": "what this is, how to cite and to read it, what the numbers mean, as a page",
    "CITATION.cff": "how to cite it, Citation File Format",
    "datacite.json": "DataCite metadata, as a DOI is registered with",
    ".estimate.json": "model, source layers and uncertainty budget of an estimated layer",
    ".tif": "calibrated values, a float32 page a band after a render",
    ".png": "render of the layer, sRGB",
}
"""What a file is by the end of its name, the first that fits."""
WITHIN = {
    "registration": "record of the registration: map, errors, verdict",
    "charts": "what was measured of the chart",
    FOLDER: "table that the campaign names",
}
"""What any other file of a folder is."""
LEVKAS = "https://doi.org/10.3390/computation7030047"
"""Where Levkas is described: the paper whose system it implements, until it has an address of its own."""

Entity = dict[str, Any]


def write_crate(publication: Publication) -> Iterator[str]:
    """Write ro-crate-metadata.json for all files of the folder."""
    yield "describing every file"
    publication.write_text(NAME, to_json(describe_crate(publication)))


def describe_crate(publication: Publication) -> dict[str, Any]:
    """Return the metadata document of a publication."""
    entities: dict[str, Entity] = {}
    root = _describe_root(publication, entities)
    entities[NAME] = {
        "@id": NAME,
        "@type": "CreativeWork",
        "conformsTo": {"@id": PROFILE},
        "about": {"@id": "./"},
    }
    entities["./"] = {"@id": "./", "@type": "Dataset", "conformsTo": {"@id": PROCESS}, **root}
    profile = {"@type": ["CreativeWork", "Profile"], "name": "Process Run Crate", "version": "0.5"}
    entities[PROCESS] = {"@id": PROCESS, **profile}
    graph = [_singled(entity) for entity in sorted(entities.values(), key=_order)]
    return {"@context": [f"{PROFILE}/context", TERMS], "@graph": graph}


def _singled(entity: Entity) -> Entity:
    """Return an entity whose lists of one are that one, as the specification recommends."""
    return {k: v[0] if isinstance(v, list) and len(v) == 1 else v for k, v in entity.items()}


def _order(entity: Entity) -> tuple[int, str]:
    first = [NAME, "./"]
    return (first.index(entity["@id"]) if entity["@id"] in first else len(first), entity["@id"])


def _describe_root(publication: Publication, entities: dict[str, Entity]) -> Entity:
    """Fill `entities` by their ids, and return the properties of the root."""
    facts = publication.facts
    files = _describe_files(publication, entities)
    actions = describe_steps(publication, entities)
    _program(entities, __version__)
    people = [_person(entities, person, i) for i, person in enumerate(facts.creators)]
    root: Entity = {
        "name": facts.title,
        "description": describe_dataset(publication),
        "datePublished": facts.published,
        "license": _licence(entities, facts),
        "author": people,
        "hasPart": [{"@id": identifier} for identifier in sorted(files)],
        "mentions": actions,
    }
    if facts.publisher:
        entities["#publisher"] = {
            "@id": "#publisher",
            "@type": "Organization",
            "name": facts.publisher,
        }
        root["publisher"] = {"@id": "#publisher"}
    if facts.doi:
        root["identifier"] = DOI + facts.doi
    if facts.contact:
        entities["#contact"] = {
            "@id": "#contact",
            "@type": "ContactPoint",
            "contactType": "about the data",
            "name": facts.contact,
        } | ({"email": facts.contact} if "@" in facts.contact else {})
        root["contactPoint"] = {"@id": "#contact"}
        answering = (root.get("publisher") or people[0])["@id"]
        entities[answering]["contactPoint"] = {"@id": "#contact"}
    for address in facts.related:
        entities.setdefault(address, {"@id": address, "@type": "ScholarlyArticle", "name": address})
    optional = {
        "citation": [{"@id": address} for address in dict.fromkeys(facts.related)],
        "keywords": ", ".join(facts.keywords),
        "version": facts.version,
        "url": facts.url or publication.url,
        "dateCreated": facts.date,
    }
    return root | {key: value for key, value in optional.items() if value}


# --- files ----------------------------------------------------------------------------------------


def _describe_files(publication: Publication, entities: dict[str, Entity]) -> list[str]:
    """Describe each file, folders of many small ones as a whole; return the ids."""
    from levkas.database.manifest import list_files

    root, found = publication.folder, []
    for name in list_files(root):
        whole = _whole_of(name)
        if whole is None:
            entity = _file(publication, root, name)
        else:
            entity = {"@id": f"{quote(whole)}/", "@type": "Dataset", "name": whole}
            entity["description"] = WHOLE[whole.partition("/")[0]]
        if entity["@id"] not in entities:
            entities[entity["@id"]] = entity
            found.append(entity["@id"])
    return found


def _whole_of(name: str) -> str | None:
    """Return the folder that is described as one thing, for a file that is in one."""
    parts = name.split("/")
    if len(parts) > 1 and parts[0] in WHOLE:
        return "/".join(parts[: 2 if parts[0] == "zarr" else 1])
    return None


def _file(publication: Publication, root: Path, name: str) -> Entity:
    path = root / name
    inside = WITHIN.get(Path(name).parent.name) or WITHIN.get(name.partition("/")[0])
    what = next((what for end, what in KINDS.items() if name.endswith(end)), inside)
    entity: Entity = {
        "@id": quote(name),
        "@type": "File",
        "name": path.name,
        "contentSize": str(path.stat().st_size),
        "encodingFormat": FORMATS.get(path.suffix, "application/octet-stream"),
    }
    if what:
        entity["description"] = what
    if name in publication.hashes:
        entity["sha256"] = publication.hashes[name]
    return entity


# --- people and licence ---------------------------------------------------------------------------


def _person(entities: dict[str, Entity], person: Person, number: int) -> Entity:
    identifier = ORCID + person.orcid if person.orcid else f"#creator-{number + 1}"
    entity: Entity = {
        "@id": identifier,
        "@type": "Organization" if person.organisation else "Person",
        "name": person.name,
    }
    given, family = person.parts
    if not person.organisation and given:
        entity |= {"givenName": given, "familyName": family}
    if person.affiliation:
        known = [e for e in entities.values() if e["@id"].startswith("#affiliation")]
        same = [e["@id"] for e in known if e["name"] == person.affiliation]
        home = same[0] if same else f"#affiliation-{len(known) + 1}"
        entities[home] = {"@id": home, "@type": "Organization", "name": person.affiliation}
        entity["affiliation"] = {"@id": home}
    entities[identifier] = entity
    return {"@id": identifier}


def _licence(entities: dict[str, Entity], facts: PublicationFacts) -> Entity:
    licence = facts.licence
    assert licence is not None, "publish refuses a database without a licence"
    identifier = licence.url or "#licence"
    entities[identifier] = {
        "@id": identifier,
        "@type": "CreativeWork",
        "name": licence.name,
        "description": f"The licence of these data: {licence.spdx or licence.name}",
    }
    return {"@id": identifier}


VERBS = {
    "calibrate": "Calibrated on native pixels",
    "register": "Registered to the reference band",
    "resample": "Resampled once, on to the grid",
}


def describe_steps(publication: Publication, entities: dict[str, Entity]) -> list[Entity]:
    """Add an action for every stage of every layer, and for every analysis.

    Returns
    -------
    actions : list
        References to them.
    """
    actions: list[Entity] = []
    for path in sorted(publication.folder.glob(f"objects/*/{PROVENANCE}")):
        record = read_json(path)
        try:
            actions += [_step(record, step, entities) for step in record.get("steps", ())]
        except (LookupError, TypeError, AttributeError, ValueError) as error:
            name = path.relative_to(publication.folder)
            raise PublishRefused(
                Problem(
                    "E_UNREADABLE",
                    f"{PROVENANCE} does not describe the steps of a build",
                    str(publication.source / name),
                    found=f"{type(error).__name__}: {error}"[:200],
                    fix="Build the database again, or remove the file.",
                )
            ) from error
    for path in sorted(publication.folder.glob("objects/*/analysis/*.json")):
        actions.append(_analysis(publication, path, entities))
    return actions


def _analysis(publication: Publication, path: Path, entities: dict[str, Entity]) -> Entity:
    """Add the action that made one analysis, from its record."""
    record, folder = read_json(path), path.parent.relative_to(publication.folder)
    inputs = [quote((folder.parent / Path(name).name).as_posix()) for name in record["inputs"]]
    results = [quote((folder / name).as_posix()) for name in (record["file"], path.name)]
    name = f"{record['layer']}: {record['title'].lower()}"
    for result, what in zip(results, (name, f"{name}: how it was made"), strict=True):
        entities[result]["description"] = what
    method = [{"@id": record["source"]}] if "source" in record else []
    for one in method:
        _add(entities, one["@id"], {"@type": "ScholarlyArticle", "name": one["@id"]})
    entity: Entity = {
        "@type": "CreateAction",
        "name": f"{record['object']}, {name}",
        "description": "Computed from the layers where no flag makes a pixel unusable",
        "instrument": _program(entities, __version__),
        "object": [*({"@id": one} for one in inputs), *method],
        "result": [{"@id": one} for one in results],
    }
    return _add(entities, f"#{quote(path.relative_to(publication.folder).as_posix())}", entity)


def _step(
    record: Mapping[str, Any], step: Mapping[str, Any], entities: dict[str, Entity]
) -> Entity:
    name, stage = record["object"], step["stage"]
    layer = "@".join(part for part in (step["camera"], step["setup"]) if part)
    identifier = f"#{quote(f'{name}-{layer}-{stage}')}"
    inputs = [
        _input(entities, file, sha)
        for file, sha in step["inputs"].items()
        if file not in (CAMPAIGN, EDITS)
    ]
    declared = (f"{FOLDER}/{name}" for name in (CAMPAIGN, EDITS))
    inputs += [{"@id": name} for name in declared if name in entities]
    entity: Entity = {
        "@type": "CreateAction",
        "name": f"{name}, {layer}: {stage}",
        "description": VERBS.get(stage, stage),
        "instrument": _program(entities, record["levkas"]),
        "object": inputs,
    }
    products = [quote(product) for product in step["products"]]
    if results := [{"@id": product} for product in products if product in entities]:
        entity["result"] = results
    return _add(entities, identifier, entity)


def _input(entities: dict[str, Entity], file: str, sha: str) -> Entity:
    """Return the published declaration that an input is, else a document by name and hash."""
    declared = f"{FOLDER}/{quote(file)}"
    if entities.get(declared, {}).get("sha256") == sha:
        return {"@id": declared}
    document = {"@type": ["CreativeWork", "DigitalDocument"], "name": file, "sha256": sha}
    return _add(entities, f"#input-{sha[:16]}", document)


def _program(entities: dict[str, Entity], version: str) -> Entity:
    """The version of Levkas that made something; parameters and libraries of a stage stand in provenance.json."""
    facts = {"name": "Levkas", "version": version, "url": LEVKAS}
    return _add(entities, f"#levkas-{version}", {"@type": "SoftwareApplication", **facts})


def _add(entities: dict[str, Entity], identifier: str, entity: Entity) -> Entity:
    entities.setdefault(identifier, {"@id": identifier, **entity})
    return {"@id": identifier}
