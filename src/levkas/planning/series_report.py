"""Planned exposure series as records, and as text for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem
from levkas.planning.exposure_advice import BandAdvice, NoAdvice
from levkas.planning.exposure_series import ExposureSeries, SeriesWish, plan_series
from levkas.planning.loading import load_setup
from levkas.planning.setup import StudioSetup
from levkas.planning.tables import PlanRefused, StudioCameraKeys, value_problem


def camera_keys(setup: StudioSetup, name: str) -> StudioCameraKeys:
    """Return the keys of a camera of a setup file; raises `PlanRefused` where there is none such."""
    if name not in setup.cameras:
        raise PlanRefused(
            value_problem(str(setup.path), "cameras", "there is no such camera", name,
                          ", ".join(setup.cameras) or "a table [cameras.NAME]")
        )  # fmt: skip
    return setup.cameras[name].keys


def series_record(
    found: Sequence[BandAdvice],
    wish: SeriesWish,
    setup: str | Path | None = None,
    camera: str | None = None,
) -> tuple[list[ExposureSeries], list[str]]:
    """Plan the series of every band, with the sensor data of a camera in a setup file where it is named.

    Returns
    -------
    plans : list of ExposureSeries
    refused : list of str
        Why a band has none: advice on its single exposure is given nevertheless.

    Raises
    ------
    PlanRefused
        Where there is no such camera, or a region lies outside the frames.
    """
    keys = None
    if camera is not None:
        if setup is None:
            raise PlanRefused(
                Problem("E_VALUE", "a camera is named, but no setup file", field="camera",
                        found=camera, expected="--setup FILE that has it")
            )  # fmt: skip
        keys = camera_keys(load_setup(setup), camera)
    plans, refused = [], []
    for band in found:
        try:
            plans.append(plan_series(band, wish, keys))
        except NoAdvice as reason:
            refused.append(str(reason))
    return plans, refused


def series_text(plans: Sequence[ExposureSeries], refused: Sequence[str] = ()) -> str:
    """Return planned series in lines, and why some bands have none."""
    lines = [f"no series for {words}" for words in refused]
    for plan in plans:
        wish, paint = plan.wish, f"darkest paint (quantile {plan.wish.quantile:g}"
        paint += f" of {plan.channel})" if plan.channel else ")"
        times = ", ".join(f"{e.time_s:g}" for e in plan.exposures)
        head = f"{plan.name}: the object spans {np.log2(plan.brightest / plan.darkest):.1f} stops; "
        if plan.suffices:
            lines.append(
                f"{head}one exposure suffices, {times} s: {paint} has SNR {plan.snr_single:.0f}, wanted "
                f"{wish.snr:g}"
            )
        else:
            lines.append(
                f"{head}{len(plan.exposures)} exposure{'s' * (len(plan.exposures) > 1)}, {times} s: {paint} has "
                f"SNR {plan.snr_series:.1f} merged, {plan.snr_single:.1f} by the shortest alone; wanted {wish.snr:g}"
            )
        lines += [
            f"  {e.time_s:>8g} s  unsaturated {100 * e.unsaturated:6.2f} %, SNR {wish.snr:g} or more "
            f"{100 * e.reaches:6.2f} %, weighs most on {100 * e.decides:6.2f} % of the sensels"
            for e in plan.exposures
        ]
        lines.append(
            f"  below SNR {wish.snr:g}: {100 * plan.below_single:.2f} % of the sensels by the shortest alone, "
            f"{100 * plan.below_series:.2f} % merged"
        )
        lines.append(f"  ISO {plan.iso_words}")
        lines += [f"  note: {note}" for note in plan.notes]
    if any(len(plan.exposures) > 1 for plan in plans):
        lines.append('Merge them with exposures = "merge" of the camera in campaign.toml.')
    return "\n".join(lines)
