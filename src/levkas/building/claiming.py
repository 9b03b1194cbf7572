"""The folder that a build may write: a new one, or the database of this campaign, marked as such."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.campaign import CampaignInvalid
from levkas.campaign.schema.cross_checks import unusable_output
from levkas.core.locks import take
from levkas.core.ownership import IMPRINT, MARK, made, require_outside, require_path, stands_in
from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json, unusable_name
from levkas.database.catalogue import DatabaseRefused, read_catalogue
from levkas.database.layout import Places

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture

OWNER = "campaign.json"
"""Among what is kept: the folder of the campaign, relative, so that both may be moved together."""
FIX = 'Give a new folder with -o, or write output = "database".'


def places_of(campaign: Campaign, output: str | Path | None = None) -> Places:
    """Return where the database of a campaign stands, or shall; refuse what can be no folder of its own.

    CampaignInvalid where it would replace a disk, a home or the campaign, or no folder can bear its name; WriteRefused
    where it is an address of a server.
    """
    if output:
        require_path(output)
    if output and (why := unusable_name(output)):
        raise CampaignInvalid(_not_apart(campaign, why, str(output)))
    places = Places(Path(output).resolve() if output else campaign.output)
    check_apart(campaign, places.output, ())
    return places


def claim(
    campaign: Campaign, places: Places, captures: Iterable[Capture], objects: Iterable[str]
) -> None:
    """Take a folder for a campaign's database and mark it, or refuse; nothing is touched then.

    Of all `captures` that were found the frames stand in folders that no build writes into; `objects` are the names of
    all that the campaign has. Raises CampaignInvalid where the folder holds, or lies among, what the campaign is made
    of, or something exists there that no build wrote; WriteRefused where the disk refuses.
    """
    from levkas.core.files import make_folder, write_changed, write_text

    check_apart(campaign, places.output, captures)
    require_outside(places.output, fix=FIX)
    if problems := list(_foreign_products(campaign, places, set(objects))):
        raise CampaignInvalid(*problems[:10])
    for folder in (places.output, places.kept):
        make_folder(folder)
    owner = {"campaign": _relative(campaign.root, places.kept)}
    write_changed(places.kept / OWNER, (json.dumps(owner, ensure_ascii=False) + "\n").encode())
    if not (places.output / IMPRINT).is_file():
        write_text(places.output / IMPRINT, MARK)


def check_apart(campaign: Campaign, output: Path, captures: Iterable[Capture]) -> None:
    """Refuse an output that holds the campaign or its frames, or lies among frames."""
    sensors = [sensor for capture in captures for sensor in capture.sensors]
    frames = (frame for s in sensors for frame in (*s.object, *s.dark, *s.white, *s.chart))
    folders = {folder.resolve() for folder in {frame.path.parent for frame in frames}}
    among = folders - {campaign.root, *campaign.root.parents}
    why = unusable_output(output, campaign.root)
    if not why and any(output in (folder, *folder.parents) for folder in folders):
        why = "the database would replace raw frames"
    elif not why and any(folder in output.parents for folder in among):
        why = "the database would be written among raw frames"
    if why:
        raise CampaignInvalid(_not_apart(campaign, why, str(output)))


def _not_apart(campaign: Campaign, why: str, output: str) -> Problem:
    where = str(campaign.path), "campaign.output"
    return Problem("E_VALUE", why, *where, output, "a separate folder", FIX)


def _foreign_products(campaign: Campaign, places: Places, objects: set[str]) -> Iterator[Problem]:
    """Yield what stands where the build would write, and is not of this campaign's builds."""
    found = stands_in(places.output)
    if found and not (found == "a folder" and made(places.output) == "database"):
        ours = made(places.output) if found == "a folder" else None
        what = f"a {ours} by Levkas" if ours else "a folder that Levkas did not write"
        found = what if found == "a folder" else found
        yield _problem(places.output, found, "an empty folder, or a database that Levkas built")
        return
    kept = stands_in(places.kept)
    if kept and not (kept == "a folder" and (places.kept / OWNER).is_file()):
        yield _problem(places.kept, kept, "the kept data of an earlier build")
        return
    yield from _links(places.output)
    yield from _links(places.kept)
    if not found:
        return
    if (owner := _owner(places.kept)) is not None:
        if owner != campaign.root and (owner / "campaign.toml").is_file():
            yield _problem(places.output, f"the database of {owner}", f"that of {campaign.root}")
    elif places.output != campaign.output:
        try:
            others = {entry.object for entry in read_catalogue(places.output)} - objects
        except DatabaseRefused:
            others = set()
        if others:
            here = ", ".join(sorted(objects))
            yield _problem(places.output, f"objects {', '.join(sorted(others))}", f"only {here}")


def _links(root: Path) -> Iterator[Problem]:
    """Yield the links in a folder that lead out of it: a build would write through them."""
    from levkas.database.containment import find_escapes
    from levkas.database.manifest import walk_files

    if root.is_dir():
        yield from find_escapes(root, walk_files(root))


def _owner(kept: Path) -> Path | None:
    """Folder of the campaign that a database was built from last, where that is known.

    Without a record, a database that stands beside a campaign.toml is taken for that campaign's.
    """
    try:
        record = read_json(kept / OWNER)
        return Path(os.path.normpath(kept / str(record["campaign"])))
    except (Refused, ValueError, KeyError, TypeError):
        return kept.parent if (kept.parent / "campaign.toml").is_file() else None


def _relative(path: Path, start: Path) -> str:
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:  # on Windows, from one drive to another
        return path.as_posix()


def _problem(path: Path, found: str, expected: str) -> Problem:
    return Problem(
        "E_UNWRITABLE",
        "the database cannot be written to this folder",
        file=str(path),
        found=found,
        expected=expected,
        fix=FIX,
    )


PATIENCE_S, PAUSE_S = 120.0, 0.05


@contextlib.contextmanager
def in_turn(folder: Path, *, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Let one build at a time into the block, by a lock of `folder` that ends with its process.

    It spares work and keeps two from undoing each other's last words; nothing hangs on it for long:
    whoever waited `patience_s`, or stands on a file system without locks, goes on.
    """
    if os.name == "nt":  # no locks of folders
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        until = time.monotonic() + patience_s
        while take(descriptor) is False and time.monotonic() < until:
            time.sleep(PAUSE_S)
        yield
    finally:
        os.close(descriptor)
