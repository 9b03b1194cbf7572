"""Commands that plan a session: plan light, framing, exposure, filter, series."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from levkas.cli.output import (
    Json,
    Overwrite,
    print_report,
    refusing,
)

if TYPE_CHECKING:
    from levkas.planning.exposure_advice import BandAdvice

SetupPath = Annotated[Path, typer.Argument(help="Setup file, or a folder with one.")]
Lighting = Annotated[
    str | None, typer.Option("--setup-name", "-s", help="One of its setups; default the first.")
]


@refusing("plan light")
def light(
    setup: SetupPath,
    name: Lighting = None,
    optimise: Annotated[
        bool, typer.Option("--optimise", help="Find the best angle for the lamps.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", "-o", help="HTML page to write; prints on A4.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Evenness, glare, relief and bright field of a lighting, and the effect of each adjustment."""
    from levkas.core.ownership import require_free
    from levkas.planning.text_report import light_record, light_text

    if report is not None:
        require_free(report, overwrite=overwrite)
    record = light_record(setup, name, optimised=optimise)
    if report is not None:
        from levkas.pages.plan import write_report
        from levkas.planning.loading import load_setup

        record["report"] = str(write_report(report, load_setup(setup), name))
    print_report("plan light", as_json, True, [], **record)
    if not as_json:
        typer.echo(light_text(record))


@refusing("plan framing")
def framing(setup: SetupPath, as_json: Json = False) -> None:
    """Field, working distance, sampling, depth of field and diffraction of every camera."""
    from levkas.planning.framing import plan_framing
    from levkas.planning.loading import load_setup
    from levkas.planning.text_report import framing_text

    found = plan_framing(load_setup(setup))
    print_report("plan framing", as_json, True, [], cameras=[f.to_dict() for f in found])
    if not as_json:
        typer.echo(framing_text(found))


DarkFrames = Annotated[
    list[Path] | None, typer.Option("--dark", help="Dark frame or folder; may be repeated.")
]
Pattern = Annotated[
    str | None, typer.Option(help="Mosaic, such as RGGB; default from the file or campaign.toml.")
]
Black = Annotated[float | None, typer.Option(help="Black level in counts; default from the file.")]
Bits = Annotated[
    int | None,
    typer.Option(
        help="Bits of the camera's converter; default from the file or campaign.toml.",
        min=1,
        max=32,
    ),
]
Saturation = Annotated[
    float | None, typer.Option(help="Saturation in counts; default the largest code of the bits.")
]
Time = Annotated[
    float | None,
    typer.Option("--time", help="Exposure in s, if names and headers do not give it."),
]


@refusing("plan exposure")
def exposure(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(help="Frames of a white, or folders of them; one file per band."),
    ] = None,
    setup: Annotated[
        Path | None,
        typer.Option("--setup", help="Setup file, or a folder with one, instead of frames."),
    ] = None,
    name: Lighting = None,
    dark: DarkFrames = None,
    pattern: Pattern = None,
    black: Black = None,
    bits: Bits = None,
    saturation: Saturation = None,
    time: Time = None,
    report: Annotated[
        Path | None, typer.Option("--report", "-o", help="HTML page of the setup to write.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Recommend exposures from frames of a white, by channel or band; or from a setup file.

    From a setup file: exposure, SNR and limiting channel of every camera.
    """
    if setup is not None:
        record, text = _planned(setup, name, report, overwrite)
    elif frames:
        _, record, text = _advice(frames, dark, pattern, black, bits, saturation, time)
    else:
        raise typer.BadParameter("give frames of a white, or --setup FILE")
    print_report("plan exposure", as_json, True, [], **record)
    if not as_json:
        typer.echo(text)


def _advice(
    frames: Sequence[Path],
    dark: Sequence[Path] | None,
    pattern: str | None,
    black: float | None,
    bits: int | None,
    saturation: float | None,
    time: float | None,
) -> tuple[list[BandAdvice], dict[str, Any], str]:
    """Return the advice on every band of frames, with its record and its text."""
    from levkas.planning.exposure_advice import advice_text, advise_frames

    found = advise_frames(
        frames,
        dark or (),
        pattern=pattern,
        black=black,
        bits=bits,
        saturation=saturation,
        exposure_s=time,
    )
    return found, {"bands": [band.to_dict() for band in found]}, advice_text(found)


def _planned(
    setup: Path,
    name: str | None,
    report: Path | None,
    overwrite: bool,
) -> tuple[dict[str, Any], str]:
    """Return the exposures of a setup file as record and text; write its page where one is wanted."""
    from levkas.core.ownership import require_free
    from levkas.planning.text_report import exposure_record, exposure_text

    if report is not None:
        require_free(report, overwrite=overwrite)
    record = exposure_record(setup, name)
    text = exposure_text(record)
    if report is not None:
        from levkas.pages.plan import write_report
        from levkas.planning.loading import load_setup

        record["report"] = str(write_report(report, load_setup(setup), name))
        text += f"\n\nWritten: {report}"
    return record, text
