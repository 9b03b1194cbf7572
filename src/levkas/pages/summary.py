"""The report of an object in short: how well cameras overlay, glare, noise, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

from levkas.registration.advice import LEAST_OUTSIDE, percent

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.pages.page import LayerReport
    from levkas.pages.radiometry import RadiometryRow

GLARE = 0.01
"""Share of the object's pixels above which glare is to be minded."""


def describe_length(px: float, mm_per_px: float | None) -> str:
    """Return a length in px of the reference, and in mm where the sampling is known.

    >>> describe_length(0.0631, 1.212), describe_length(0.5, None)
    ('0.063 px = 0.076 mm', '0.500 px')
    """
    return f"{px:.3f} px" + (f" = {px * mm_per_px:#.2g} mm" if mm_per_px else "")


def summarise_layers(
    layers: Sequence[LayerReport],
    rows: Sequence[RadiometryRow],
    mm_per_px: float | None,
    lost: Sequence[str] = (),
    agreement: Sequence[tuple[str, str]] = (),
) -> list[tuple[str, str]]:
    """Return (mark, sentence) of what matters, the mark being ok, warn, refuse or next.

    Parameters
    ----------
    layers : sequence of LayerReport
    rows : sequence of RadiometryRow
    mm_per_px : float or None
        Of the reference.
    lost : sequence of str
        Layers that could not even be begun.
    agreement : sequence of (mark, sentence)
        How the cameras agree.
    """
    return [
        *_overlay(layers, mm_per_px),
        *(("refuse", f"{name} was left out: its frames were refused.") for name in lost),
        *_glare(rows),
        *_noise(rows),
        *agreement,
        ("next", _next(layers, rows, lost, agreement)),
    ]


def _overlay(layers: Sequence[LayerReport], mm_per_px: float | None) -> Iterator[tuple[str, str]]:
    yield from _own_bands(layers, mm_per_px)
    laid = [one for one in layers if one.decision in ("accept", "confirmed", "warn", "by hand")]
    reference = next((one.name for one in layers if one.decision == "reference"), "the reference")
    known = [one for one in laid if one.error_px is not None]
    mark = "warn" if any(one.decision in ("warn", "by hand") for one in laid) else "ok"
    if known:
        worst = max(known, key=lambda one: one.error_px or 0.0)
        assert worst.error_px is not None
        which = "Every other camera" if len(laid) > 1 else worst.name
        text = f"{which} is registered to {reference}: held-out error {describe_length(worst.error_px, mm_per_px)}"
        text += " at most" if len(laid) > 1 else ""
        least = min((one.checked for one in known if one.checked is not None), default=None)
        if least:
            some = "at least " if len(known) > 1 else ""
            text += f", checked over {some}{percent(least)} of the layer"
        if (outside := max(one.outside for one in known)) >= LEAST_OUTSIDE:
            text += f" ({percent(outside)} lies outside the object's outline)"
        yield mark, f"{text}. {f'The worst is {worst.name}.' if len(laid) > 1 else ''}".rstrip()
    elif laid:
        names = ", ".join(one.name for one in laid)
        yield mark, f"Registered to {reference}: {names}; no held-out error was measured."
    for one in layers:
        if one.earlier:
            yield "warn", f"{one.name} is of an earlier build: {one.earlier}."
        if one.lying:
            yield "warn", f"{one.name}: {one.lying}"
        if one.decision == "refuse":
            yield "refuse", f"{one.name} was left out: its registration was refused."
        elif one.decision == "confirmed":
            yield "ok", f"{one.name}: {one.reasons[0]}"
        elif one.by_hand:
            yield mark, f"{one.name} was {one.by_hand}."
        elif one.decision == "warn":
            yield "warn", f"{one.name}: {one.reasons[0] if one.reasons else 'please check it.'}"


def _own_bands(layers: Sequence[LayerReport], mm_per_px: float | None) -> Iterator[tuple[str, str]]:
    """What there is to say of a reference camera that is alone, or whose sensors are registered to one another."""
    for one in layers:
        if one.decision == "reference" and one.error_px is not None:
            text = f"The sensors of {one.name} are registered to one another: held-out error {describe_length(one.error_px, mm_per_px)}"
            text += f", checked over {percent(one.checked)} of the layer" if one.checked else ""
            yield "ok", f"{text}."
        elif one.decision == "reference" and len(layers) == 1:
            yield "ok", f"{one.name} is the only camera: nothing else is registered to it."


def _glare(rows: Sequence[RadiometryRow]) -> Iterator[tuple[str, str]]:
    known = [(row.glare_share, row.name) for row in rows if row.glare_share is not None]
    if known:
        most, name = max(known)
        text = (
            f"Glare, including saturated gold: at most {100 * most:.2g} % of the object ({name})."
        )
        yield ("warn" if most > GLARE else "ok"), text


def _noise(rows: Sequence[RadiometryRow]) -> Iterator[tuple[str, str]]:
    known = [(row.noise_median, row.name) for row in rows if row.noise_median is not None]
    if not known:
        return
    (least, best), (most, worst) = min(known), max(known)
    text = f"Noise of a published reflectance (1 σ, median): {least:.2g} ({best})"
    text += f" to {most:.2g} ({worst})." if len(known) > 1 else "."
    low = [f"{row.name}: {note}" for row in rows for note in row.notes if "SNR is below" in note]
    yield ("warn" if low else "ok"), " ".join([text, *low])


def _next(
    layers: Sequence[LayerReport],
    rows: Sequence[RadiometryRow],
    lost: Sequence[str],
    agreement: Sequence[tuple[str, str]],
) -> str:
    """Return the gravest thing to do: of a layer what its record says, too."""
    for decision in ("refuse", "by hand", "warn", "accept"):
        for one in layers:
            if one.decision == decision and one.next_step:
                return f"{one.name}: {one.next_step}"
    if lost or any(one.earlier for one in layers):
        return "Correct the refused frames, listed below, and build again."
    if any(mark == "warn" for mark, _ in agreement):
        return "Find out which of the cameras that contradict each other is wrong: a white or a chart that all of them saw decides it."
    notes = [(row.glare_share or 0.0, f"{row.name}: {row.notes[0]}") for row in rows if row.notes]
    return max(notes)[1] if notes else "No action is needed."
