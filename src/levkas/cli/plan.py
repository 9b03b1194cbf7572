"""Commands that plan a session: plan light, framing, exposure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from levkas.cli.output import (
    Json,
    Overwrite,
    print_report,
    refusing,
)

SetupPath = Annotated[Path, typer.Argument(help="Setup file, or a folder with one.")]
Lighting = Annotated[
    str | None, typer.Option("--setup-name", "-s", help="One of its setups; default the first.")
]


@refusing("plan light")
def light(
    setup: SetupPath,
    name: Lighting = None,
    optimise: Annotated[
        bool, typer.Option("--optimise", help="Search the best positions for two lamps.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", "-o", help="HTML page to write; prints on A4.")
    ] = None,
    overwrite: Overwrite = False,
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """Evenness, glare, relief and bright field of a lighting, and the effect of each adjustment."""
    from levkas.core.ownership import require_free
    from levkas.planning.text_report import light_record, light_text

    if report is not None:
        require_free(report, overwrite=overwrite)
    record = light_record(setup, name, optimised=optimise, seed=seed)
    if report is not None:
        from levkas.pages.plan import write_report

        record["report"] = str(write_report(report, record.setup, name, seed=seed))
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


@refusing("plan exposure")
def exposure(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(help="Frames of a white, or folders of them; one file per band."),
    ] = None,
    setup: Annotated[
        Path | None,
        typer.Option(
            "--setup", help="Setup file, or a folder with one; instead of frames or with them."
        ),
    ] = None,
    name: Lighting = None,
    dark: Annotated[
        list[Path] | None, typer.Option("--dark", help="Dark frame or folder; may be repeated.")
    ] = None,
    pattern: Annotated[
        str | None, typer.Option(help="Pattern of a mosaic, such as RGGB; default from the file.")
    ] = None,
    black: Annotated[
        float | None, typer.Option(help="Black level in counts; default from the file.")
    ] = None,
    bits: Annotated[
        int | None,
        typer.Option(
            help="Bits of the camera's converter; default from the file or campaign.toml.",
            min=1,
            max=32,
        ),
    ] = None,
    saturation: Annotated[
        float | None,
        typer.Option(help="Saturation in counts; default the largest code of the bits."),
    ] = None,
    time: Annotated[
        float | None, typer.Option(help="Exposure in s, if names and headers do not give it.")
    ] = None,
    of_object: Annotated[
        bool,
        typer.Option(
            "--object", help="The frames show the object; gold may be brighter than a white."
        ),
    ] = False,
    snr: Annotated[
        float,
        typer.Option(
            help="With --object: SNR to reach at one sensel of the darkest paint, linear."
        ),
    ] = 20.0,
    quantile: Annotated[
        float,
        typer.Option(help='Share of the object that is darker than its "darkest paint".'),
    ] = 0.01,
    longest: Annotated[
        float | None, typer.Option(help="Longest exposure of the camera, s.")
    ] = None,
    region: Annotated[
        str | None, typer.Option(help="x,y,width,height of the object, native pixels.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="Camera of the setup file that took the frames. From its white the regulating filter "
            "is computed; with --object its noise and full well determine times and ISO."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report",
            "-o",
            help="HTML page to write: the setup with its filter, or with --object the series.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Recommend exposures from frames, by channel or band, with SNR and ISO.

    From frames of the object (--object) also an exposure series that reaches an SNR at its darkest paint. From a setup file: exposure, SNR and limiting channel of every camera, regulating filter, dose, flicker.
    """
    if not frames and setup is None:
        raise typer.BadParameter("give frames of a white, --setup FILE, or both")
    if camera and (not frames or setup is None):
        raise typer.BadParameter("--camera needs frames and --setup FILE")
    series_wanted = bool(frames) and of_object
    if report is not None:
        from levkas.core.ownership import require_free

        if setup is None and not series_wanted:
            raise typer.BadParameter(
                "--report needs --setup FILE, or frames of the object and --object"
            )
        require_free(report, overwrite=overwrite)
    white = None
    record: dict[str, Any] = {}
    texts = []
    if frames:
        from levkas.planning.exposure_advice import advice_text, advise_frames, white_levels

        found = advise_frames(
            frames,
            dark or (),
            pattern=pattern,
            black=black,
            bits=bits,
            saturation=saturation,
            exposure_s=time,
            is_white=not of_object,
        )
        record["bands"] = [c.to_dict() for c in found]
        texts.append(advice_text(found))
        if series_wanted:
            from levkas.planning.exposure_series import SeriesWish

            wish = SeriesWish(snr, quantile, longest, _four(region) if region else None)
            told, words = _series(found, wish, (setup, camera), report)
            record.update(told)
            texts += words
        elif camera:
            white = white_levels(found, camera)
    if setup is not None and not (series_wanted and camera):
        from levkas.planning.text_report import exposure_record, exposure_text

        planned = exposure_record(setup, name, white)
        record.update(planned)
        texts.append(exposure_text(planned))
        if report is not None and not series_wanted:
            from levkas.pages.plan import write_report
            from levkas.planning.loading import load_setup

            record["report"] = str(write_report(report, load_setup(setup), name, white=white))
            texts.append(f"Written: {report}")
    print_report("plan exposure", as_json, True, [], **record)
    if not as_json:
        typer.echo("\n\n".join(texts))


def _series(
    found: list[Any], wish: Any, sensor: tuple[Path | None, str | None], report: Path | None
) -> tuple[dict[str, Any], list[str]]:
    """Plan the exposure series of an object; `sensor` is a setup file and its camera."""
    from levkas.planning.series_report import series_record, series_text

    plans, refused = series_record(found, wish, *sensor)
    record: dict[str, Any] = {
        "series": [plan.to_dict() for plan in plans],
        "series_refused": refused,
    }
    texts = [series_text(plans, refused)]
    if report is not None:
        from levkas.pages.series import write_series

        record["report"] = str(write_series(report, plans, refused))
        texts.append(f"Written: {report}")
    return record, texts


def _four(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter("--region is x,y,width,height, whole numbers") from None
    return x, y, width, height
