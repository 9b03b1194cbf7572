"""Exposure advice for people: channels, histograms, the time to set, and why."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, log10
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.exposure_levels import Advice, limiting, safe_mean, snr_at

if TYPE_CHECKING:
    from levkas.planning.exposure_advice import Coached

SHADES = " ▁▂▃▄▅▆▇█"


def advice_text(coached: Sequence[Coached]) -> str:
    """Return advice for people: channels, histogram, time, why, and ISO."""
    lines: list[str] = []
    for found in coached:
        first, poorest = limiting(found.advices)
        shot = found.shot
        time = f"{shot.exposure_s:g} s" if shot.exposure_s else "unknown time"
        lines.append(f"{shot.name}: {time}, {shot.stack.count} shot{'s' * (shot.stack.count > 1)}")
        lines += [_channel_line(found, advice) for advice in found.advices]
        then = f"{first.time_s:.3g} s" if first.time_s else f"{first.factor:.2f} times as long"
        lines.append(
            f"  set {then} ({first.stops:+.2f} stops): brings {first.reading.channel or 'it'} to "
            f"{100 * first.target:.0f} % of saturation"
        )
        if len(found.advices) > 1 and isnan(shot.wavelength):
            behind = np.log2(first.reading.mean / max(poorest.reading.mean, 1e-9))
            lines.append(
                f"  {first.reading.channel} saturates first; {poorest.reading.channel} gets {behind:.1f} stops "
                "less light: a regulating filter or a lamp richer there would even them out"
            )
        lines.append(f"  ISO: {found.iso_advice}")
        lines += [f"  note: {note}" for note in found.notes]
    lines.append(f"full scale: {coached[0].full:.0f} counts ({coached[0].full_from})")
    lines.append(_why(coached[0]))
    if len(coached) > 1 and all(c.first.time_s for c in coached):
        total = sum(c.first.time_s or 0.0 for c in coached)
        slow = max(coached, key=lambda c: c.first.time_s or 0.0)
        lines.append(
            f"all {len(coached)} bands: {total:.3g} s a series; {slow.shot.name} takes longest, "
            f"{slow.first.time_s:.3g} s"
        )
    return "\n".join(lines)


def _why(found: Coached) -> str:
    """Return where the target comes from, with its numbers."""
    first = found.first
    full_well = first.reading.room / found.sensor.gain
    usual = safe_mean(full_well, prnu=found.sensor.prnu)
    told = (
        f"why {100 * first.target:.0f} %: f = 1/[(1 + z√(1/(f·FW) + PRNU²))(1 + U/2)(1 + drift)], so that one "
        f"pixel in a million clips (z 4.75) with FW {full_well:,.0f} e⁻, PRNU "
        f"{100 * found.sensor.prnu:.2g} % {'measured' if found.prnu_known else 'assumed'}, a lamp that drifts by 1 %"
    )
    if not found.is_white:
        return f"{told}; the object's own peak is kept there, U = 0"
    return (
        f"{told}, and light that varies by U = {100 * first.reading.unevenness:.0f} % over the field; "
        f"at 10 % it would be {100 * usual:.0f} %"
    )


def _channel_line(found: Coached, advice: Advice) -> str:
    reading = advice.reading
    bars = np.add.reduceat(reading.histogram, np.arange(0, len(reading.histogram), 2))
    height = np.ceil(8 * np.sqrt(bars / max(bars.max(), 1))).astype(int)
    drawn = "".join(SHADES[h] for h in height)
    then = snr_at(advice, found.sensor, found.first.factor)
    return (
        f"  {reading.channel or 'all':4} |{drawn}| mean {100 * reading.mean / reading.room:5.1f} %, "
        f"{reading.stops_left:5.2f} stops left, clipped {100 * reading.clipped:.2f} %, "
        f"SNR {advice.snr_now:.0f} now, {then:.0f} then ({10 * log10(max(then, 1e-9)):.1f} dB)"
    )
