"""The rules of RO-Crate 1.1, checked without a network: structure, root, references, files.

Those that its specification calls MUST, and the one that we add: every file is described, itself or
by a folder that is described as a whole. `ask_validator` asks roc-validator.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from levkas.core.problems import Problem
from levkas.core.text import parse_json

NAME = "ro-crate-metadata.json"
PREVIEW = "ro-crate-preview.html"
PROFILE = "https://w3id.org/ro/crate/"
DATE = re.compile(r"\d{4}(-\d\d(-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?)?)?)?")
NO_URI = re.compile(r"""[\s<>"{}|\\^`]""")
REQUIRED = ("name", "description", "datePublished", "license")
PROFILES = (("ro-crate-1.3",), ("process-run-crate", "-nh"))
"""Of roc-validator; its Process Run Crate is asked alone, for it inherits a rule that RO-Crate is 1.1."""

Entity = dict[str, Any]


def check_crate(folder: str | Path) -> list[Problem]:
    """Check ro-crate-metadata.json of a folder against the rules and against the folder.

    Returns
    -------
    problems : list of Problem
        Empty where all rules are kept.
    """
    path = Path(folder) / NAME
    try:
        document = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        return [_wrong(path, "", f"it cannot be read: {error}")]
    graph = document.get("@graph") if isinstance(document, dict) else None
    if not isinstance(graph, list) or not all(isinstance(e, dict) for e in graph):
        return [_wrong(path, "@graph", "it is no list of entities")]
    problems = [*_check_context(path, document), *_check_entities(path, graph)]
    if problems:
        return problems
    entities = {entity["@id"]: entity for entity in graph}
    return [
        *_check_descriptor(path, entities),
        *_check_root(path, entities),
        *_check_references(path, entities),
        *_check_files(path, entities),
        *_check_preview(path, document, entities),
    ]


def _check_context(path: Path, document: dict[str, Any]) -> Iterator[Problem]:
    context = document.get("@context")
    parts = context if isinstance(context, list) else [context]
    if not any(isinstance(p, str) and p.startswith(PROFILE) for p in parts):
        yield _wrong(path, "@context", "it does not name RO-Crate's context")


def _check_preview(
    path: Path, document: dict[str, Any], entities: dict[str, Entity]
) -> Iterator[Problem]:
    """The page, where there is one, is described and holds a copy of the document in its head."""
    page = path.with_name(PREVIEW)
    if not page.is_file():
        return
    if entities.get(PREVIEW, {}).get("about") != {"@id": "./"}:
        yield _wrong(path, PREVIEW, "the page is not described as being about ./")
    head, _, _ = page.read_text(encoding="utf-8").partition("</head>")
    copies = re.findall(r'<script type="application/ld\+json">(.*?)</script>', head, re.S)
    if [parse_json(copy) for copy in copies] != [document]:
        yield _wrong(path, PREVIEW, "the head of the page holds no copy of the document")


def _check_entities(path: Path, graph: list[Entity]) -> Iterator[Problem]:
    found: set[str] = set()
    for place, entity in enumerate(graph):
        identifier = entity.get("@id")
        if not isinstance(identifier, str) or not identifier:
            yield _wrong(path, f"@graph[{place}]", "an entity has no @id")
            continue
        if identifier in found:
            yield _wrong(path, identifier, "two entities have one @id")
        found.add(identifier)
        if NO_URI.search(identifier):
            yield _wrong(path, identifier, "its @id is no URI: encode what is not allowed in one")
        if not entity.get("@type"):
            yield _wrong(path, identifier, "the entity has no @type")
        if "WebSite" in _types(entity) and not entity.get("name"):
            yield _wrong(path, f"{identifier} name", "the web site lacks it")
        for key, value in entity.items():
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, dict) and set(part) != {"@id"} and "@value" not in part:
                    yield _wrong(path, f"{identifier} {key}", "an entity stands inside another one")


def _check_descriptor(path: Path, entities: dict[str, Entity]) -> Iterator[Problem]:
    descriptor = entities.get(NAME)
    if descriptor is None or "CreativeWork" not in _types(descriptor):
        yield _wrong(path, NAME, "the document does not describe itself as a CreativeWork")
        return
    if descriptor.get("about") != {"@id": "./"} or "./" not in entities:
        yield _wrong(path, f"{NAME} about", "it is not about ./")
    conforms = _references(descriptor.get("conformsTo"))
    plain = [v for v in _listed(descriptor.get("conformsTo")) if isinstance(v, str)]
    if plain or not any(identifier.startswith(f"{PROFILE}1.") for identifier in conforms):
        yield _wrong(path, f"{NAME} conformsTo", "it does not say which RO-Crate it is")


def _check_root(path: Path, entities: dict[str, Entity]) -> Iterator[Problem]:
    root = entities.get("./", {})
    if "Dataset" not in _types(root):
        yield _wrong(path, "./", "the root is no Dataset")
    for key in REQUIRED:
        if not root.get(key):
            yield _wrong(path, f"./ {key}", "the root lacks it")
    for publisher in _references(root.get("publisher")):
        if not {"Organization", "Person"} & _types(entities.get(publisher, {})):
            yield _wrong(path, "./ publisher", "it is no Organization or Person", publisher)
    for part in _references(root.get("hasPart")):
        if part in entities and not {"File", "Dataset"} & _types(entities[part]):
            yield _wrong(path, "./ hasPart", "it is no File and no Dataset", part)
    for entity in entities.values():
        for picture in _references(entity.get("thumbnail")):
            if picture in entities and "File" not in _types(entities[picture]):
                yield _wrong(path, f"{entity['@id']} thumbnail", "it is no File", picture)
    date = root.get("datePublished")
    if date and not (isinstance(date, str) and DATE.fullmatch(date)):
        yield _wrong(path, "./ datePublished", "it is no date as ISO 8601", date)


def _check_references(path: Path, entities: dict[str, Entity]) -> Iterator[Problem]:
    """What an entity refers to is there; all data hang below the root."""
    for identifier, entity in entities.items():
        for key, value in entity.items():
            for target in _references(value) if not key.startswith("@") else ():
                if target not in entities and not re.match(r"[a-z][a-z0-9+.-]*:", target):
                    yield _wrong(path, f"{identifier} {key}", "it refers to nothing", target)
    reached, waiting = {"./"}, ["./"]
    while waiting:
        for part in _references(entities.get(waiting.pop(), {}).get("hasPart")):
            if part not in reached:
                reached.add(part)
                waiting.append(part)
    for identifier, entity in entities.items():
        if identifier not in reached and _is_data(identifier, entity):
            yield _wrong(path, identifier, "no hasPart leads to it from the root")


def _check_files(path: Path, entities: dict[str, Entity]) -> Iterator[Problem]:
    """Files and folders that are described stand there; those that stand there are described."""
    from levkas.database.manifest import list_files

    root, folders, files = path.parent, [], {NAME, PREVIEW, "manifest-sha256.txt"}
    for identifier, entity in entities.items():
        if not _is_data(identifier, entity) or identifier == "./":
            continue
        name = unquote(identifier)
        if "File" in _types(entity):
            files.add(name)
            if not (root / name).is_file():
                yield _wrong(path, identifier, "there is no such file")
            elif (size := str((root / name).stat().st_size)) != entity.get("contentSize", size):
                yield _wrong(path, identifier, "the file has another size", size)
            continue
        if not identifier.endswith("/"):
            yield _wrong(path, identifier, "the id of a folder does not end with /")
        if not (root / name).is_dir():
            yield _wrong(path, identifier, "there is no such folder")
        if "hasPart" not in entity:
            folders.append(name)
    for name in list_files(root):
        if name not in files and not name.startswith(tuple(folders)):
            yield _wrong(path, name, "the file is not described")


def _is_data(identifier: str, entity: Entity) -> bool:
    local = not re.match(r"[a-z][a-z0-9+.-]*:", identifier) and not identifier.startswith("#")
    return local and bool({"File", "Dataset"} & _types(entity))


def _types(entity: Entity) -> set[str]:
    kind = entity.get("@type", ())
    return {kind} if isinstance(kind, str) else set(kind)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _references(value: Any) -> list[str]:
    parts = _listed(value)
    return [str(p["@id"]) for p in parts if isinstance(p, dict) and set(p) == {"@id"}]


def _wrong(path: Path, field: str, why: str, found: Any = None) -> Problem:
    return Problem(
        "E_CRATE",
        f"{NAME} breaks a rule of RO-Crate: {why}",
        file=str(path),
        field=field or None,
        found=found,
        fix="Publish again; where it was edited by hand, mend the field.",
    )


# --- another opinion ------------------------------------------------------------------------------


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


def ask_validator(folder: str | Path, report: Path) -> list[str]:
    """Ask roc-validator, in a process of its own and without a network, for what is required.

    Returns
    -------
    found : list of str
        Rule, entity and words of every finding.
    """
    found: list[str] = []
    for profile, *alone in PROFILES:
        command = [sys.executable, "-c", OFFLINE, "-y", "validate", "--no-paging", "--no-cache"]
        command += ["-l", "required", "-f", "json", "-o", str(report), "-p", profile, *alone]
        done = subprocess.run([*command, str(folder)], capture_output=True, text=True, check=False)
        assert report.is_file(), done.stdout + done.stderr
        read = parse_json(report.read_text(encoding="utf-8"))
        assert sum(read["statistics"]["total_checks_by_severity"].values()) > 3, read["statistics"]
        for issue in read["issues"]:
            rule = issue["check"]["identifier"]
            found.append(f"{rule} {issue['violatingEntity']}: {issue['message']}")
        report.unlink()
    return found
