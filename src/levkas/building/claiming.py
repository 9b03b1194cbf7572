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
PATIENCE_S, PAUSE_S = 120.0, 0.05


def places_of(campaign: Campaign, output: str | Path | None = None) -> Places:
    """Return where the database of a campaign stands, or shall; refuse what can be no folder of its own.

    CampaignInvalid where it would replace a disk, a home or the campaign, or no folder can bear its name; WriteRefused
    where it is an address of a server.
    """
    if output:
        require_path(output)
        if why := unusable_name(output):
            raise _not_apart(campaign, why, output)
    places = Places(Path(output).resolve() if output else campaign.output)
    check_apart(campaign, places.output, ())
    return places


def claim(
    campaign: Campaign, places: Places, captures: Iterable[Capture], objects: Iterable[str]
) -> None:
    """Take a folder for a campaign's database and mark it, or refuse; nothing is touched then.

    `captures` are all that were found, `objects` all that the campaign has. Raises CampaignInvalid where the folder holds, or lies
    among, what the campaign is made of, or something exists there that no build wrote; WriteRefused where the disk refuses.
    """
    from levkas.core.files import make_folder, write_changed, write_text

    check_apart(campaign, places.output, captures)
    require_outside(places.output, fix=FIX)
    if problems := list(_foreign(campaign, places, set(objects))):
        raise CampaignInvalid(*problems[:10])
    for folder in (places.output, places.kept):
        make_folder(folder)
    try:
        root = Path(os.path.relpath(campaign.root, places.kept)).as_posix()
    except ValueError:  # on Windows, from one drive to another
        root = campaign.root.as_posix()
    owner = json.dumps({"campaign": root}, ensure_ascii=False) + "\n"
    write_changed(places.kept / OWNER, owner.encode())
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
        raise _not_apart(campaign, why, output)


def _not_apart(campaign: Campaign, why: str, output: str | Path) -> CampaignInvalid:
    where = str(campaign.path), "campaign.output"
    return CampaignInvalid(Problem("E_VALUE", why, *where, str(output), "a separate folder", FIX))


def _foreign(campaign: Campaign, places: Places, objects: set[str]) -> Iterator[Problem]:
    """Yield what stands where the build would write, and is not of this campaign's builds."""
    from levkas.database.manifest import find_escapes, walk_files

    output, kept = places.output, places.kept
    found, beside = stands_in(output), stands_in(kept)
    if found and not (found == "a folder" and made(output) == "database"):
        ours = made(output) if found == "a folder" else None
        what = f"a {ours} by Levkas" if ours else "a folder that Levkas did not write"
        what = what if found == "a folder" else found
        yield _occupied(output, what, "an empty folder, or a database that Levkas built")
        return
    if beside and not (beside == "a folder" and (kept / OWNER).is_file()):
        yield _occupied(kept, beside, "the kept data of an earlier build")
        return
    for root in (output, kept):  # a build would write through links
        yield from find_escapes(root, walk_files(root)) if root.is_dir() else ()
    owner = _owner(kept) if found else campaign.root
    if owner is None and output != campaign.output:
        with contextlib.suppress(DatabaseRefused):
            if others := {entry.object for entry in read_catalogue(output)} - objects:
                here = f"only {', '.join(sorted(objects))}"
                yield _occupied(output, f"objects {', '.join(sorted(others))}", here)
    elif owner not in (None, campaign.root) and (owner / "campaign.toml").is_file():
        yield _occupied(output, f"the database of {owner}", f"that of {campaign.root}")


def _owner(kept: Path) -> Path | None:
    """Return the folder of the campaign that a database was built from last, where that is known.

    Without a record, a database that stands beside a campaign.toml is taken for that campaign's.
    """
    try:
        return Path(os.path.normpath(kept / str(read_json(kept / OWNER)["campaign"])))
    except (Refused, ValueError, KeyError, TypeError):
        return kept.parent if (kept.parent / "campaign.toml").is_file() else None


def _occupied(path: Path, found: str, expected: str) -> Problem:
    message = "the database cannot be written to this folder"
    return Problem("E_UNWRITABLE", message, str(path), None, found, expected, FIX)


@contextlib.contextmanager
def in_turn(folder: Path, *, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Let one build at a time into the block, by a lock of `folder` that ends with its process.

    It spares work and keeps two from undoing each other's last words: whoever waited `patience_s`, or stands on a file system
    without locks, goes on.
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
