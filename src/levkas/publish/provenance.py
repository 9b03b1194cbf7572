"""Provenance for the RO-Crate: one action a step, with program, parameters and inputs."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from levkas import __version__
from levkas.core.text import read_json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from levkas.publish.publication import Publication

    Entity = dict[str, Any]

PROVENANCE = "provenance.json"
VERBS = {
    "calibrate": "Calibrated on native pixels",
    "measure": "Registered by itself, to be adjusted with other captures",
    "register": "Registered to the reference band",
    "resample": "Resampled once, on to the grid",
}
LIBRARY = "#library-"


def describe_steps(publication: Publication, entities: dict[str, Entity]) -> list[Entity]:
    """Add an action for every stage of every layer, and for the parts of the publication.

    Returns
    -------
    actions : list
        References to them.
    """
    actions: list[Entity] = []
    for path in sorted(publication.folder.glob(f"objects/*/{PROVENANCE}")):
        record = read_json(path)
        for step in record.get("steps", ()):
            actions.append(_step(record, step, entities))
    actions += _editions(publication, entities)
    return actions


def describe_tools(publication: Publication, entities: dict[str, Entity]) -> None:
    """Add this program, and the libraries whose version may be in the numbers."""
    program: Entity = {
        "@id": _program(__version__),
        "@type": "SoftwareApplication",
        "name": "Levkas",
        "version": __version__,
    }
    libraries = {i for i in entities if i.startswith(LIBRARY)}
    if libraries:
        program["softwareRequirements"] = [{"@id": i} for i in sorted(libraries)]
    entities[program["@id"]] = program


def _step(
    record: Mapping[str, Any], step: Mapping[str, Any], entities: dict[str, Entity]
) -> Entity:
    name, stage = record["object"], step["stage"]
    layer = "@".join(part for part in (step["camera"], step["setup"]) if part)
    identifier = f"#{quote(f'{name}-{layer}-{stage}')}"
    program = _program(record["levkas"])
    entities.setdefault(
        program,
        {
            "@id": program,
            "@type": "SoftwareApplication",
            "name": "Levkas",
            "version": record["levkas"],
        },
    )
    for library, version in record.get("libraries", {}).items():
        _add(
            entities,
            f"{LIBRARY}{library}-{version}",
            {"@type": "SoftwareApplication", "name": library, "version": version},
        )
    inputs = [
        _add(
            entities,
            f"#input-{sha[:16]}",
            {"@type": "DigitalDocument", "name": file, "sha256": sha},
        )
        for file, sha in step["inputs"].items()
    ]
    parameters = {**step["parameters"], "code": step["code"]}
    entity: Entity = {
        "@type": "CreateAction",
        "name": f"{name}, {layer}: {stage}",
        "description": VERBS.get(stage, stage),
        "instrument": {"@id": program},
        "object": inputs + [_parameter(entities, k, v) for k, v in parameters.items()],
    }
    products = [quote(product) for product in step["products"]]
    if results := [{"@id": product} for product in products if product in entities]:
        entity["result"] = results
    return _add(entities, identifier, entity)


def _parameter(entities: dict[str, Entity], name: str, value: Any) -> Entity:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    digest = hashlib.sha256(f"{name}={text}".encode()).hexdigest()[:12]
    return _add(
        entities, f"#parameter-{digest}", {"@type": "PropertyValue", "name": name, "value": text}
    )


def _editions(publication: Publication, entities: dict[str, Entity]) -> list[Entity]:
    """The medium edition and the tiles, where they are there."""
    from levkas.publish.publication import MEDIUM

    made = {
        f"{MEDIUM}/": "Resampled to at most 640 x 480 pixels, sigma and flags carried along",
        "iiif/": "Cut into tiles for IIIF viewers",
    }
    actions = []
    for folder, what in made.items():
        if folder in entities:
            entity = {
                "@type": "CreateAction",
                "name": folder.rstrip("/"),
                "description": what,
                "instrument": {"@id": _program(__version__)},
                "object": [{"@id": "objects/"}],
                "result": [{"@id": folder}],
            }
            actions.append(_add(entities, f"#made-{folder.rstrip('/')}", entity))
    return actions


def _program(version: str) -> str:
    return f"#levkas-{version}"


def _add(entities: dict[str, Entity], identifier: str, entity: Entity) -> Entity:
    entities.setdefault(identifier, {"@id": identifier, **entity})
    return {"@id": identifier}
