"""Do the cameras agree? Sentences, a table and plots of how layers of one object compare."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas import __version__
from levkas.pages.page import Figure, embed_png, render_page
from levkas.pages.plots import Line, colour_of, in_style, new_figure, plot, to_svg
from levkas.quality.evaluation.camera_agreement import BandAgreement, PairAgreement

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.quality.evaluation.database_agreement import ObjectAgreement

EVEN = 0.35
"""Standard deviation of the ratios of all bands over their mean difference, up to which that is one of the light or the white, and not
of wavelengths."""
MOST_MAPS = 4


class AgreementRow(NamedTuple):
    """One pair of layers as a reader sees it."""

    pair: str
    bands: str
    ratio: str
    expected_ratio: str
    finding: str


class AgreementSection(NamedTuple):
    """What the page says of all pairs."""

    short: tuple[tuple[str, str], ...]
    rows: tuple[AgreementRow, ...]
    figures: tuple[Figure, ...]


def describe_agreement(pairs: Sequence[PairAgreement]) -> AgreementSection | None:
    """Return sentences (mark, text), table and plots; None where no two layers could be compared."""
    if not pairs:
        return None
    rows = tuple(_row(pair) for pair in pairs)
    odd = [pair for pair in pairs if pair.contradictions and not pair.other_light]
    figures = [figure for figure in (_ratios(pairs),) if figure]
    figures += [
        _map(max(mine, key=lambda pair: pair.worst.expected_ratio)) for _, mine in _by_layer(odd)
    ][:MOST_MAPS]
    return AgreementSection(tuple(_short(pairs, odd)), rows, tuple(figures))


def _short(
    pairs: Sequence[PairAgreement], odd: Sequence[PairAgreement]
) -> Iterator[tuple[str, str]]:
    alike = [pair for pair in pairs if not pair.other_light]
    if not odd and alike:
        most = max(abs(band.ratio - 1) for pair in alike for band in pair.bands)
        yield (
            "ok",
            f"The cameras agree within their uncertainties, to {100 * most:.2g} % or better in the {len(alike)} pairs that could be "
            f"compared{'; an error that all share does not show in that' if alike[0].unknown else ''}.",
        )
    for name, mine in _by_layer(odd):
        yield "warn", _sentence(name, mine)


def _by_layer(odd: Sequence[PairAgreement]) -> list[tuple[str, list[PairAgreement]]]:
    """Return the layers that differ most from others, all of them together, each with its pairs; a pair stands once.

    Where three cameras all contradict one another, a white that is off by a tenth is told from wavelengths that are off by a hundredth.
    """
    left, found = list(odd), []
    while left:
        apart: dict[str, float] = {}
        for pair in left:
            for name in pair.names:
                apart[name] = apart.get(name, 0.0) + _difference(pair)
        worst = max(apart, key=lambda name: apart[name])
        mine = [pair for pair in left if worst in pair.names]
        left = [pair for pair in left if pair not in mine]
        found.append((worst if len(mine) > 1 else mine[0].names[1], mine))
    return found


def _difference(pair: PairAgreement) -> float:
    """Return by how much the bands of a pair that contradict each other differ, relative."""
    return float(median(abs(np.log(band.ratio)) for band in pair.contradictions))


def _sentence(name: str, pairs: Sequence[PairAgreement]) -> str:
    """Report by how much a layer differs from others, where, and what may be the cause."""
    others = [p.names[p.names[0] == name] for p in pairs]
    bands = [(pair, band) for pair in pairs for band in pair.contradictions]
    ratios = [b.ratio if p.names[1] == name else 1 / b.ratio for p, b in bands]
    every = [b.ratio if p.names[1] == name else 1 / b.ratio for p in pairs for b in p.bands]
    apart = 100 * (median(ratios) - 1)
    span = _span([band for _, band in bands])
    worst = max(band.expected_ratio for _, band in bands)
    cause = (
        "white, lamp or angle of the light?"
        if float(np.std(every)) < EVEN * abs(median(every) - 1)
        else "wavelengths, sensitivities or stray light?"
    )
    unknown = dict.fromkeys(row for pair in pairs for row in pair.unknown)
    absent = f" Not known of them: {', '.join(unknown)}." if unknown else ""
    return (
        f"{name} differs from {', '.join(dict.fromkeys(others))} by {apart:+.2g} % in {span}, more than their uncertainties allow "
        f"(Eₙ {worst:.2g}): {cause}{absent}"
    )


def _span(bands: Sequence[BandAgreement]) -> str:
    least, most = (f([band.wavelength for band in bands]) for f in (min, max))
    if len({band.band for band in bands}) == 1 or not np.isfinite([least, most]).all():
        return ", ".join(dict.fromkeys(band.band for band in bands))
    return f"{least:.0f} to {most:.0f} nm"


def _row(pair: PairAgreement) -> AgreementRow:
    ratios = [band.ratio for band in pair.bands]
    expected = [band.expected_ratio for band in pair.bands]
    ends = dict.fromkeys(f"{pick(ratios):.3f}" for pick in (min, max))
    finding, odd = "agree", len(pair.contradictions)
    if odd:
        apart = f"contradict each other in {odd} of {len(ratios)} bands"
        finding = "another lighting" if pair.other_light else apart
    return AgreementRow(
        f"{pair.names[1]} over {pair.names[0]}",
        f"{len(pair.bands)}, {_span(pair.bands)}",
        " to ".join(ends),
        f"{median(expected):.2g}, at most {max(expected):.2g}",
        finding,
    )


def _ratios(pairs: Sequence[PairAgreement]) -> Figure | None:
    """Draw the ratio of each pair over the wavelength."""
    lines = [
        Line(
            f"{pair.names[1]} / {pair.names[0]}",
            [band.wavelength for band in ordered],
            [band.ratio for band in ordered],
            colour_of("", k, len(pairs)),
        )
        for k, pair in enumerate(pairs)
        if (ordered := sorted(pair.bands, key=lambda band: band.wavelength))
    ]
    svg = plot(lines, x="wavelength, nm", y="ratio")
    caption = "Median ratio of even patches, by pair: 1 where two cameras agree."
    return Figure(svg, caption) if svg else None


def _map(pair: PairAgreement) -> Figure:
    band = pair.worst
    return Figure(
        _draw_map(pair, band),
        f"{pair.names[1]} over {pair.names[0]} in {band.band}, patch by patch: a difference that changes over the painting is one of the light's evenness.",
    )


@in_style
def _draw_map(pair: PairAgreement, band: BandAgreement) -> str:
    figure = new_figure(420, 300)
    axes = figure.subplots()
    x, y = pair.places.T
    spread = max(float(np.nanmax(np.abs(band.values - 1))), 0.01)
    dots = axes.scatter(
        x, y, c=band.values, cmap="RdBu_r", vmin=1 - spread, vmax=1 + spread, s=28, edgecolors="#888", linewidths=0.4
    )  # fmt: skip
    axes.set(xlabel="x, px", ylabel="y, px", aspect="equal")
    axes.invert_yaxis()
    figure.colorbar(dots, ax=axes, label="ratio")
    return to_svg(figure, f"ratio of {pair.names[1]} to {pair.names[0]} over the painting")


# --- two databases --------------------------------------------------------------------------------


def render_agreement(first: str, second: str, found: Sequence[ObjectAgreement]) -> str:
    """Return the page that compares two databases as HTML."""
    return render_page(
        "agree.html",
        page={
            "title": "Two databases compared",
            "subtitle": f"{second} against {first}",
            "objects": [_object(one) for one in found],
            "footer": f"Levkas {__version__}. Ratios are of the second database over the first or of the camera with fewer bands over that with "
            "more, as the table says.",
        },
    )


def write_agreement(
    first: str,
    second: str,
    found: Sequence[ObjectAgreement],
    folder: Path,
    *,
    overwrite: bool = False,
) -> Path:
    """Write agreement.html and agreement.json into a folder; return the page.

    Raises
    ------
    WriteRefused
        Where a file of the name is there already.
    """
    from levkas.core.files import before_writing, write_json, write_text
    from levkas.core.ownership import new_files

    folder = folder.resolve()
    path = folder / "agreement.html"
    with before_writing(new_files(folder, overwrite=overwrite)):
        write_json(folder / "agreement.json", {"objects": [one.to_dict() for one in found]})
        write_text(path, render_agreement(first, second, found))
    return path


def agreement_text(found: Sequence[ObjectAgreement]) -> str:
    """Return what two databases agree about in words, an object a paragraph."""
    lines = []
    for one in found:
        section = describe_agreement(one.pairs)
        lines += ["", _title(one)]
        lines += [f"  {text}" for _, text in (section.short if section else ())]
        for row in section.rows if section else ():
            lines.append(
                f"  {row.pair:32} ratio {row.ratio:16} En {row.expected_ratio:22} {row.finding}"
            )
        lines.append(f"  {describe_changes(one)}")
    return "\n".join(lines[1:])


def _title(one: ObjectAgreement) -> str:
    name = one.name if one.name == one.other else f"{one.name} and {one.other}"
    return f"{name}: nothing was compared" if one.agrees is None else name


def describe_changes(one: ObjectAgreement) -> str:
    """Report how much of an object changed, and what chance alone marks."""
    if one.changes is None:
        return "No layer of one has the bands of a layer of the other, with its noise known: changes were not looked for."
    return (
        f"{100 * one.changes.share:.2g} % of the pixels of {one.compared} differ by more than their random uncertainties allow; "
        f"{100 * one.changes.rate:.2g} % would by chance. What the whole pictures differ by is taken out first."
    )


def _object(one: ObjectAgreement) -> dict[str, Any]:
    from levkas.database.preview import encode_png

    error = "" if one.error_px is None else f", held-out error {one.error_px:.3f} px"
    picture = ""
    if one.changes is not None:
        shades = np.where(one.changes.mask, 255, np.where(one.changes.known, 110, 0))
        picture = embed_png(encode_png(shades.astype(np.uint8)))
    areas = one.changes.areas if one.changes else ()
    return {
        "title": _title(one),
        "registered": f"The second was registered to the first{error}.",
        "agreement": describe_agreement(one.pairs),
        "changed": describe_changes(one),
        "map": picture,
        "areas": [[*map(str, area[:4]), f"{area[4]:+.3f}"] for area in areas],
    }
