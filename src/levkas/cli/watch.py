"""The command that looks over the shoulder while frames are captured: watch."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from levkas.cli.output import Json, print_report, refusing
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.workbench.watching import SessionState, WatchedSession
    from levkas.workbench.watching.files import FrameState

COLOURS = {"green": typer.colors.GREEN, "look": typer.colors.YELLOW, "stop": typer.colors.RED}
BELLS = {"look": 1, "stop": 3}


@refusing("watch")
def watch(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder into which the cameras write, with campaign.toml or without."),
    ],
    once: Annotated[
        bool, typer.Option("--once", help="Judge what is there, list what is missing, and end.")
    ] = False,
    bell: Annotated[
        bool,
        typer.Option("--bell", help="Ring the terminal once at a look, three times at a stop."),
    ] = False,
    port: Annotated[
        int, typer.Option(help="Port of the page; 0 uses any free one.", min=0, max=65535)
    ] = 0,
    no_open: Annotated[
        bool, typer.Option("--no-open", help="Print the address without opening a browser.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Watch a session while it lasts: each frame is green, look or stop, with the reason and what to do now."""
    from levkas.workbench.watching import WatchedSession

    if not folder.is_dir():
        folder = folder.parent if folder.name == "campaign.toml" else folder
    session = WatchedSession(folder)
    if once or as_json:
        _finish(session.settle(), as_json, folder)
    _follow(session, port, browse=not no_open, bell=bell)


def _follow(session: WatchedSession, port: int, *, browse: bool, bell: bool) -> None:
    """Print what happens, and show it on the page, until Ctrl-C."""
    from levkas.workbench.watching.page import SessionBoard, WatchServer

    board = SessionBoard(session)
    server = WatchServer(board, port)
    root, verdicts = session.watch.root, dict[str, str]()
    typer.echo(f"Watching {root} by looking at it three times a second. Press Ctrl-C to end.")
    typer.echo(f"The page is at {server.address.url}")
    if browse:
        server.opening.show()
    try:
        for state, fresh in session.follow():
            board.publish(state)
            _print_fresh(fresh, verdicts, bell)
    except KeyboardInterrupt:
        typer.echo()
    finally:
        server.stop()
    print_missing(session.state())


def _print_fresh(fresh: Sequence[FrameState], verdicts: dict[str, str], bell: bool) -> None:
    """Print a line a frame; of one that was printed before what has changed."""
    for frame in fresh:
        if frame.verdict == "waiting":
            continue
        before = verdicts.get(frame.file.name)
        if before == frame.verdict == "green":
            continue
        verdicts[frame.file.name] = frame.verdict
        print_frame(frame, again=before is not None)
        if bell and before != frame.verdict:
            typer.echo("\a" * BELLS.get(frame.verdict, 0), nl=False)


def print_frame(frame: FrameState, *, again: bool = False) -> None:
    """Print one frame: time, verdict, what it is; below it what is wrong and what to do."""
    now = "now " if again else ""
    typer.echo(time.strftime("%H:%M:%S "), nl=False)
    typer.secho(f"{now}{frame.verdict:<6}", fg=COLOURS.get(frame.verdict), nl=False)
    typer.echo(f" {frame.what}  ({frame.file.name})")
    for finding in frame.findings:
        advice = finding.advice[:1].upper() + finding.advice[1:]
        typer.echo(f"         {finding.text}. {advice}.")


def print_missing(state: SessionState) -> None:
    """Print counts, and what is to be captured before the object leaves."""
    counts = state.to_dict()["counts"]
    typer.echo(", ".join(f"{number} {verdict}" for verdict, number in counts.items() if number))
    if state.guessed:
        typer.echo("There is no campaign.toml: cameras, darks and whites are guessed.")
    if state.strays:
        few = ", ".join(state.strays[:3]) + (" …" if len(state.strays) > 3 else "")
        typer.echo(f"No pattern of campaign.toml fits {few}.")
    for text in state.problems:
        typer.secho(text, fg=typer.colors.RED)
    if not state.missing:
        typer.echo("Nothing is missing." if state.frames else "No frame came.")
        return
    typer.echo("Before the object leaves:")
    for item in state.missing:
        again = " again" if item.kind == "again" else ""
        typer.echo(f"  capture {item.what}{again} ({item.why})")


def _finish(state: SessionState, as_json: bool, folder: Path) -> None:
    if not state.frames:
        why, there = "there is no frame to judge", [*state.problems, *state.strays[:3]]
        wanted = "frames that `levkas look` knows, or that patterns of campaign.toml fit"
        found = "; ".join(there) or None
        raise Refused(Problem("E_NO_FRAMES", why, str(folder), None, found, wanted))
    problems = [
        Problem("E_FRAME", finding.text, frame.file.name, finding.check, fix=finding.advice)
        for frame in state.frames
        for finding in frame.findings
        if finding.severity == "stop"
    ]
    record = state.to_dict()
    texts = record.pop("problems")
    if as_json:
        print_report("watch", True, not problems, problems, session=record, doubts=texts)
    else:
        for frame in state.frames:
            if frame.findings:
                print_frame(frame)
        print_missing(state)
    raise typer.Exit(1 if problems else 0)
