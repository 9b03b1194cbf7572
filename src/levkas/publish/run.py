"""Publishing from beginning to end: built aside, read back and compared, renamed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.problems import Problem, Refused
from levkas.core.text import missing_path
from levkas.publish.analysis_names import parse_analyses
from levkas.publish.crate import NAME as CRATE
from levkas.publish.metadata import NAME as FACTS
from levkas.publish.metadata import PublicationFacts, facts_of, missing_facts, read_facts
from levkas.publish.publication import (
    Publication,
    PublishRefused,
    layers_without,
    require_earlier,
    require_ours,
)

if TYPE_CHECKING:
    from levkas.database.manifest import Manifest
    from levkas.publish.analysis_names import Analysis
    from levkas.publish.publication import Publication

    Part = Callable[[Publication], Iterator[str]]

SPACE = 1.6
"""Of the database: with tiles and pages beside it."""


@dataclass(frozen=True)
class PublishSubject:
    """What is to be published: a database, and the campaign it was built from where that was given."""

    database: Path
    campaign: Path | None = None
    without: tuple[str, ...] = ()
    """Layers that are left out, as `levkas.publish.publication.layers_without` reads them."""

    @property
    def default_output(self) -> Path:
        """Folder of the publication where none is given: ``NAME.published`` beside the database."""
        return self.database.with_name(self.database.name + ".published")


@dataclass(frozen=True)
class PublishStep:
    """One thing that a part does; the last one of a part is `finished`."""

    part: str
    what: str = ""
    done: int = 0
    total: int = 0
    finished: bool = False
    state: str = "running"
    report: PublishReport | None = None
    """Of the very last step."""

    @property
    def label(self) -> str:
        """The part, and what it is doing."""
        return f"{self.part} {self.what}".strip()[:60]

    @property
    def line(self) -> str:
        """One line for a log."""
        return f"{self.part}: {self.state}"


@dataclass(frozen=True)
class PublishReport:
    """The end of a publication."""

    output: Path
    files: int
    bytes: int
    deposit: tuple[Problem, ...] = ()
    """What a repository must know before it gives a DOI."""
    left_out: tuple[str, ...] = ()
    """What could not be made, and why."""

    @property
    def text(self) -> str:
        """Report for people."""
        text = f"Published {self.output}: {self.files} files, {self.bytes / 1e6:.1f} MB"
        text += "".join(f"\nLeft out: {note}" for note in self.left_out)
        missing = ", ".join(p.message for p in self.deposit)
        return text + (f"\nBefore it gets a DOI: {missing}" if missing else "")

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` adds to the problems."""
        return {
            "output": str(self.output),
            "files": self.files,
            "bytes": self.bytes,
            "left_out": list(self.left_out),
        }


@dataclass(frozen=True)
class CheckReport:
    """What a database lacks before it is published: what must be there, and what should be."""

    problems: tuple[Problem, ...]
    advice: tuple[Problem, ...]
    deposit: tuple[Problem, ...] = ()
    """What a repository must know before it gives a DOI; a publication can be made without."""

    @property
    def ok(self) -> bool:
        """Whether nothing that is required is missing."""
        return not self.problems

    @property
    def text(self) -> str:
        """Report for people."""
        lines = [f"{word}: {p.message}\n  do: {p.fix}" for word, p in self._wanted()]
        end = "Nothing that `levkas publish` requires is missing." if self.ok else ""
        count = len(self.problems)
        end = end or f"{count} required item{'s are' if count > 1 else ' is'} missing."
        if self.ok and self.deposit:
            end += f" A DOI needs {len(self.deposit)} more."
        return "\n".join([*lines, end])

    def _wanted(self) -> Iterator[tuple[str, Problem]]:
        yield from (("Needed for a DOI", problem) for problem in self.deposit)
        yield from (("Advised", problem) for problem in self.advice)

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` adds to the problems."""
        reports = {"advice": self.advice, "deposit": self.deposit}
        return {key: [p.to_dict() for p in problems] for key, problems in reports.items()}


def check(
    path: str | Path,
    *,
    output: str | Path | None = None,
    url: str = "",
    analyse: Sequence[str] = (),
    without: Sequence[str] = (),
) -> CheckReport:
    """Check what is missing before a database can be published, and before it can get a DOI; nothing is written.

    What is a problem here is what `publish` refuses before it reads the files of the database, and nothing
    else is.

    Parameters
    ----------
    path : path
        A database, or its campaign, whose facts are taken as they are now.
    output, url, analyse, without
        As of `publish`.

    Returns
    -------
    report : CheckReport
        Each problem with file, field and what to write there.
    """
    from levkas.publish.analysis import check_analyses
    from levkas.publish.citation import check_datacite

    problems: list[Problem] = []
    subject = find_subject(path, fresh=False)
    analyses: tuple[Analysis, ...] = ()
    whole = False
    with _listed(problems):
        analyses = parse_analyses(analyse)
    with _listed(problems):
        _check_address(url)
    with _listed(problems):
        whole = bool(find_manifest(subject.database))
    for step in (
        lambda: find_subject(path, without=without),
        lambda: layers_without(subject.database, without),
        lambda: check_analyses(subject.database, analyses),
        lambda: check_places(subject, facts_of_subject(subject), output),
    ):
        with _listed(problems):
            if whole:
                step()
    if problems and subject.campaign is None and not (subject.database / FACTS).is_file():
        return CheckReport(tuple(problems), ())
    facts = facts_of_subject(subject)
    deposit, advice = check_datacite(facts)
    return CheckReport((*problems, *missing_facts(facts)), tuple(advice), tuple(deposit))


@contextmanager
def _listed(problems: list[Problem]) -> Iterator[None]:
    """Add the problems of a refusal to a list, and go on."""
    try:
        yield
    except Refused as refused:
        problems += [problem for problem in refused.problems if problem not in problems]


def find_subject(
    path: str | Path, *, fresh: bool = True, without: Sequence[str] = ()
) -> PublishSubject:
    """Find the database of a campaign, or take a path as a database.

    Parameters
    ----------
    path : path
    fresh : bool
        Whether the database must be up to date with its campaign.
    without : sequence of str
        Layers that are left out; of cameras among them nothing need be fresh.

    Raises
    ------
    Refused
        Where a campaign cannot be read, or has not been built to the end.
    """
    path = Path(path)
    if path.name != "campaign.toml" and not (path / "campaign.toml").is_file():
        return PublishSubject(path, None, tuple(without))
    from levkas.building import status
    from levkas.campaign.campaign import load_campaign

    campaign = load_campaign(path)
    stages = status(path).stages if fresh else ()
    old = {"stale", ("refused", "report"), ("refused", "camera")}  # a refused page is as it was
    of_others = (step for step in stages if step.key.camera not in without)
    stale = [step for step in of_others if {step.state, (step.state, step.key.stage)} & old]
    if stale:
        raise PublishRefused(
            Problem(
                "E_STALE",
                "the database is older than its campaign",
                file=str(campaign.output),
                found=f"{len(stale)} stage{'s are' if len(stale) > 1 else ' is'} stale, the first: {stale[0].line}",
                fix=f"Run levkas build {campaign.root} first, or give the database folder to publish it unchanged.",
            )
        )
    return PublishSubject(campaign.output, campaign.path, tuple(without))


def publish(
    path: str | Path | PublishSubject,
    *,
    output: str | Path | None = None,
    url: str = "",
    iiif: bool = True,
    analyse: Sequence[str] = (),
) -> Iterator[PublishStep]:
    """Publish a database, yielding what is done, and in the end a report.

    Parameters
    ----------
    path : path or PublishSubject
        A database, or a campaign that has been built.
    output : path, optional
        Default: ``NAME.published`` beside the database. An earlier publication there is replaced
        when the new one is whole.
    url : str, optional
        Address under which the folder will be found.
    iiif : bool
        Whether tiles and IIIF manifests are made.
    analyse : sequence of str
        Analyses of the layers, as `levkas.publish.analysis_names.parse_analyses` reads them.

    Raises
    ------
    PublishRefused
        Where a layer is of an earlier build and not left out, facts are missing, the database is not whole, `output`
        holds it, or lies in it, or `output` is the publication of another database.
    WriteRefused
        Where `output` is anything but an earlier publication, or the disk refuses; an earlier
        publication is kept then.
    """
    from levkas.core.files import publishing, sweep_beside
    from levkas.database.manifest import write_manifest
    from levkas.publish.analysis import check_analyses
    from levkas.publish.citation import check_datacite

    analyses = parse_analyses(analyse)
    _check_address(url)
    subject = path if isinstance(path, PublishSubject) else find_subject(path)
    manifest = find_manifest(subject.database)
    gone = layers_without(subject.database, subject.without)
    check_analyses(subject.database, analyses)
    facts = facts_of_subject(subject)
    if problems := missing_facts(facts):
        raise PublishRefused(*problems)
    final = check_places(subject, facts, output)
    if final.parent.is_dir():
        sweep_beside(final)
    with publishing(final, bytes_needed=int(SPACE * manifest.bytes)) as folder:
        source, address = subject.database.resolve(), _with_slash(url)
        publication = Publication(
            *(source, manifest, folder, facts, address, iiif),
            analyses,
            campaign=subject.campaign,
            without=gone,
        )
        yield from _run(publication)
        made = write_manifest(folder.path, publication.hashes)
        _check_whole(publication)
        _check_output(final, source, facts)  # files may have come into it meanwhile
    needed = tuple(check_datacite(facts)[0])
    left_out = tuple(publication.left_out)
    report = PublishReport(final, len(made.files) + 1, made.bytes, needed, left_out)
    yield PublishStep("publication", "", len(PARTS), len(PARTS), True, "done", report)


def facts_of_subject(subject: PublishSubject) -> PublicationFacts:
    """Return the facts of a database, as its campaign declares them now where that is known."""
    facts = read_facts(subject.database)
    if subject.campaign is None:
        return facts
    from levkas.building.catalogue import imprint_of
    from levkas.campaign.campaign import load_campaign
    from levkas.database.catalogue import DatabaseRefused, read_catalogue

    try:
        entries = read_catalogue(subject.database)
    except DatabaseRefused:
        entries = ()
    record = imprint_of(load_campaign(subject.campaign), entries)
    return facts_of(record, file=str(subject.campaign), objects=facts.objects)


def find_manifest(database: Path) -> Manifest:
    """Read the manifest of a database that is to be published.

    Raises
    ------
    PublishRefused
        Where there is none, it is damaged, lists too little, or something leads out of the database.
    DatabaseRefused
        Where the catalogue cannot be read, or names in it are paths.
    """
    from levkas.database.catalogue import NAME as CATALOGUE
    from levkas.database.catalogue import read_catalogue
    from levkas.database.manifest import NAME, find_escapes, is_partial, list_files, read_manifest

    path = database / NAME
    if (absent := missing_path(database)) is not None:
        raise PublishRefused(absent)
    if not path.is_file():
        found = "a folder without one" if database.is_dir() else "a file"
        raise PublishRefused(
            Problem(
                "E_UNREADABLE",
                "no finished database was found here: the manifest, which a build writes last, is missing",
                file=str(path),
                found=found,
                fix="Give a finished database, or the folder of its campaign.",
            )
        )
    manifest = read_manifest(path)
    if manifest.problems:
        raise PublishRefused(*manifest.problems)
    if CRATE in manifest.files:
        raise PublishRefused(
            Problem(
                "E_VALUE",
                "this folder is a publication already",
                file=str(database),
                found=CRATE,
                expected="the database it was made from",
                fix="Give that database, or the folder of its campaign.",
            )
        )
    names = list_files(database)
    if escapes := list(find_escapes(database, names)):
        raise PublishRefused(*escapes[:10])
    listed = {*manifest.files, NAME}
    extra = [name for name in names if name not in listed and not is_partial(name)]
    if extra:
        raise PublishRefused(
            Problem(
                "E_EXTRA",
                "the database holds files that its manifest does not list",
                file=str(database / extra[0]),
                found=f"{len(extra)} files",
                fix="Remove them, or run levkas build again to update the manifest.",
            )
        )
    if CATALOGUE in manifest.files:
        read_catalogue(database)
    return manifest


def _run(publication: Publication) -> Iterator[PublishStep]:
    total = len(PARTS)
    for done, name in enumerate(PARTS):
        for what in load_part(name)(publication):
            yield PublishStep(name, what, done, total)
        yield PublishStep(name, "", done + 1, total, True, "done")


def check_places(
    subject: PublishSubject,
    facts: PublicationFacts,
    output: str | Path | None,
) -> Path:
    """Return the folder of a publication; refuse it where something else is there."""
    final = _final(subject, output)
    _check_output(final, subject.database.resolve(), facts)
    return final


def _final(subject: PublishSubject, output: str | Path | None) -> Path:
    return Path(output or subject.default_output).resolve()


def _check_address(url: str) -> None:
    """Refuse what is no address of a folder on the web: IIIF and the crate would name it all over."""
    from levkas.campaign.schema.values import is_address

    if url and not is_address(url):
        expected = "an address that begins with https:// or http://"
        raise PublishRefused(
            Problem("E_VALUE", "this is not the address of a folder", None, "--url", url, expected)
        )


def _check_output(final: Path, database: Path, facts: PublicationFacts) -> None:
    """Refuse a folder that is none of ours, one that holds, or lies in, what is published, and another publication."""
    fix = "Give another folder with -o."
    if final == database or database in final.parents or final in database.parents:
        raise PublishRefused(
            Problem(
                "E_UNWRITABLE",
                "the publication cannot be written to this folder: it contains the database or is inside it",
                file=str(final),
                expected="a new folder, or an earlier publication of this database",
                fix=fix,
            )
        )
    require_ours(final, "publication", fix=fix)
    require_earlier(final, database, facts, fix=fix)


def _check_whole(publication: Publication) -> None:
    """Read everything that was written again, and compare."""
    from levkas.database.validation import check_files

    found = [p for step in check_files(publication.folder) for p in step.problems]
    if found:
        raise PublishRefused(*found[:10])


def _with_slash(url: str) -> str:
    return url if not url or url.endswith("/") else url + "/"


def summarise(steps: Iterable[PublishStep]) -> PublishReport:
    """Return the report that ends the steps."""
    return next(step.report for step in steps if step.report)


PARTS = {
    "content": "levkas.publish.publication:write_content",
    "analysis": "levkas.publish.analysis:write_analyses",
    "colour": "levkas.publish.swatches:write_gamut",
    "iiif": "levkas.publish.iiif:write_iiif",
    "declarations": "levkas.publish.declarations:write_declarations",
    "citation": "levkas.publish.citation:write_citation",
    "datacite": "levkas.publish.citation:write_datacite",
    "viewer": "levkas.publish.viewer.run:write_part",
    "readme": "levkas.publish.readme:write_readme",
    "crate": "levkas.publish.crate:write_crate",
}
"""Name of a part → where its function is; imported when it is run."""


def load_part(name: str) -> Part:
    """Return the function of a part."""
    module, _, function = PARTS[name].partition(":")
    part: Part = getattr(import_module(module), function)
    return part
