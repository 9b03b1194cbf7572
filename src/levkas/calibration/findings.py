"""What a person should know of a capture: one table of findings, and the one place that turns them into words or a refusal."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import nan
from typing import Literal, NamedTuple

from levkas.core.problems import Problem, Refused

Severity = Literal["note", "doubt", "refuse"]


class CalibrationRefused(Refused):
    """Frames from which no trustworthy values can be had."""


class Row(NamedTuple):
    """A kind of finding. `found` and `expected` are templates of subject, number and limit.

    ``note``: nothing is wrong with values. ``doubt``: they may be. ``refuse``: none are made; `error` is then its code.
    """

    severity: Severity
    message: str
    found: str = ""
    expected: str = ""
    advice: str = ""
    error: str = ""
    field: str | None = None


@dataclass(frozen=True)
class Finding:
    """A row of `FINDINGS` that holds: of a band, file or target, by a number, with the limit that it passes.

    `found` and `expected` take the place of the row's.
    """

    code: str
    subject: str = ""
    number: float = nan
    limit: float = nan
    file: str | None = None
    camera: str = ""
    found: str = ""
    expected: str = ""

    @property
    def severity(self) -> Severity:
        """How grave it is."""
        return FINDINGS[self.code].severity

    @property
    def advice(self) -> str:
        """What to do about it."""
        return self._filled(FINDINGS[self.code].advice)

    def describe(self) -> str:
        """Return one sentence with the number, and what to do.

        >>> Finding("moved", number=2.0).describe()
        'some pixels moved between shots: 2 % of them, which are flagged'
        """
        row = FINDINGS[self.code]
        found = self.found or self._filled(row.found)
        said = self._filled(row.message) + (f": {found}" if found else "")
        return said + (f". {self.advice}" if row.advice else "")

    def problem(self) -> Problem:
        """Return the refusal."""
        row = FINDINGS[self.code]
        field = None if row.field is None else self._filled(row.field)
        found, expected = (
            self.found or self._filled(row.found),
            self.expected or self._filled(row.expected),
        )
        said = self._filled(row.message)
        return Problem(
            row.error, said, self.file, field, found or None, expected or None, self.advice or None
        )

    def _filled(self, text: str) -> str:
        return text.format(
            subject=self.subject, number=self.number, limit=self.limit, camera=self.camera
        )


def refusal(code: str, *values: object, **more: object) -> CalibrationRefused:
    """Return the refusal of one finding, of the values of a `Finding`."""
    return CalibrationRefused(Finding(code, *values, **more).problem())  # type: ignore[arg-type]


def decide(findings: Iterable[Finding | str]) -> list[str]:
    """Return what is told, doubts first; words that others chose stay as they are.

    Raises CalibrationRefused with every finding that is refused.

    Examples
    --------
    >>> decide([Finding("moved", number=50.0), "", "as it is"])
    ['some pixels moved between shots: 50 % of them, which are flagged', 'as it is']
    """
    every = [one for one in dict.fromkeys(findings) if one]
    graded = [one for one in every if isinstance(one, Finding)]
    if refused := [one.problem() for one in graded if one.severity == "refuse"]:
        raise CalibrationRefused(*refused)
    doubts = [one for one in graded if one.severity == "doubt"]
    said = [*doubts, *(one for one in every if one not in doubts)]
    return [one if isinstance(one, str) else one.describe() for one in said]


SAME_MODE = "Capture dark and white in the same mode and with the same crop as the object."
NO_SHOTS = (
    "Give another scene a name of its own; of a bracket, of several lights, or of shots between which something moved, keep one, "
    'or state the times of a bracket and write exposures = "merge".'
)
NO_LIGHT = "Was the lamp off, a lens cap on or the shutter closed, or are these darks? Capture it again, or correct the names."
STATE_TIME = "Put {{exposure}} with its unit into the names and `files`, or list the files in a `manifest` with exposure_s."
FEW_SHOTS = "Capture two shots or more of each target"
OF_SHOTS = "what the first shot shows, with other noise and some per cent of the lamp"
FINDINGS = {
    # single frames
    "eight_bits": Row(
        "refuse", "the frame has 8 bits, and more are declared", "codes up to {number:.0f}", "codes up to {limit:.0f}",
        "Export the frames again in 16 bits; write `bits = 8` only if the camera has no more.", "E_BITS", "cameras.{camera}.bits",
    ),
    "codes_exceed": Row(
        "refuse", "codes exceed the bits that are declared", "{number:.0f}", "at most {limit:g}",
        "Correct `bits`. If they are stored in the upper bits of a code, write `saturation` in stored codes.",
        "E_BITS", "cameras.{camera}.bits",
    ),
    "constant": Row(
        "refuse", "the frame holds one value", "{number:g} in every pixel", "what a sensor recorded, with its noise",
        "The frame was damaged or exported empty: copy or export it again, or remove it from the campaign.", "E_CONSTANT",
    ),
    "few_codes": Row(
        "doubt", "8 bits were stretched to {subject}", "{number:.0f} codes, {limit:.0f} or more apart",
        advice="The tones between are lost: export the frames again in all their bits",
    ),
    "low_codes": Row(
        "doubt", "{subject} bits are declared, and the codes have 8", "none exceeds {number:.0f}",
        advice="The frames have fewer bits, or very little light",
    ),
    "tone_curve": Row(
        "doubt", "by the file its codes have a tone curve", "{subject}",
        advice="They are taken as proportional to light: export linear frames",
    ),
    "pages": Row("note", "the first page is used, the others are not", "{number:.0f} pages in {subject}"),
    "bad_bands": Row(
        "note", "bands are bad by the file (bbl)", "{number:.0f} of {limit:.0f}: {subject}",
        advice="They are flagged as defects, and have no part in registration and colours",
    ),
    "lost": Row("note", "values that are not finite numbers are flagged as defects", "{subject}: {number:.0f} of {limit:.0f}"),
    "moved": Row("note", "some pixels moved between shots", "{number:.2g} % of them, which are flagged"),
    # sizes and numbers of frames
    "size": Row("refuse", "{subject} and object differ in size", advice=SAME_MODE, error="E_SIZE", field="{subject}"),
    "band_size": Row(
        "refuse", "band {subject} differs in size from the other bands", error="E_SIZE", field="width, height",
        advice="Use a frame of the correct camera, captured in the mode of the others.",
    ),
    "chart_size": Row(
        "refuse", "chart and object differ in size", "{subject}", "that of the object", "Capture the chart in the object's mode.",
        "E_SIZE", "cameras.{camera}.white.chart",
    ),
    "smaller_than_pattern": Row("refuse", "the frame is smaller than its pattern", error="E_SIZE", field="pattern"),
    "white_missing": Row(
        "refuse", "no white for band {subject}", "no file", "a white frame of {subject}",
        "Add the frame, or remove the band from `wavelengths`.", "E_TEMPLATE_MISSING", "cameras.{camera}.files",
    ),
    "no_frames": Row("refuse", "there are no frames to average", "0", "1 or more", error="E_NO_FRAMES"),
    "no_real_array": Row("refuse", "a frame is not a real array (h, w) or (h, w, b)", "{subject}", error="E_VALUE"),
    "shot_size": Row("refuse", "shot {subject} differs from shot 0 in size", advice=SAME_MODE, error="E_SIZE"),
    "shot_type": Row("refuse", "shot {subject} differs from shot 0 in type", advice=SAME_MODE, error="E_VALUE"),
    "many_shots": Row("refuse", "too many shots", "{number:.0f}", "at most {limit:.0f}", error="E_VALUE"),
    "no_values": Row(
        "refuse", "no value is finite{subject}", "", "finite numbers", "Export the frame again, or remove it from `files`.",
        "E_VALUE", "pixels",
    ),
    # shots of one scene
    "unlike_whites": Row(
        "refuse", "the shots of the white contradict each other", "parts differ by up to {number:.0%} from the middle of them: {subject}",
        "the same board in every shot, within {limit:.0%}",
        "Remove the shots in which something stood before the board, or it had moved, or other light fell.", "E_UNLIKE_SHOTS",
    ),
    **{
        f"other_{what}": Row(
            "refuse", f"a shot differs from the first of its stack in {what}", "{subject}", OF_SHOTS, NO_SHOTS, "E_UNLIKE_SHOTS", what
        )
        for what in ("scene", "place", "light", "exposure")
    },
    "white_shots": Row(
        "doubt", "shots of the white differ from place to place: something moved, or the light flickers in bands",
        "up to {number:.2%}", advice="Values there may be wrong by as much",
    ),
    # exposures
    "exposures_declared": Row(
        "refuse", "shots of several exposures", "{subject}", "one exposure",
        'Write exposures = "best" (the longest unsaturated) or "merge".', "E_EXPOSURES", "cameras.{camera}.exposures",
    ),
    "times_missing": Row(
        "refuse", "some frames state their exposure, and others do not", "{subject}",
        "an exposure for every frame of object, white and dark, or for none", STATE_TIME, "E_EXPOSURES", "exposure",
    ),
    "exposure_unknown": Row(
        "refuse", "an exposure is unknown", "{subject}", "seconds, > 0, of every frame", STATE_TIME, "E_EXPOSURES", "exposure",
    ),
    "darks_unknown": Row(
        "refuse", "there are several darks, and their exposures are unknown", "{subject}", "",
        "Put {{exposure}} into the file pattern, or keep one dark.", "E_EXPOSURES", "exposure",
    ),
    "not_a_series": Row(
        "refuse", "these exposures cannot be merged", "{subject}", "two or more different exposures of one size",
        'Average shots of equal exposure first, or set exposures = "one".', "E_EXPOSURES", "exposures",
    ),
    "not_linear": Row(
        "refuse", "the counts are not proportional to the exposure", "rms deviation {number:.1%}, {subject}", "at most {limit:.1%} rms",
        "Check exposure times and black level, and leave out the frames of a wrong time. Of a sensor that is not linear "
        'set exposures = "best", and capture the white at the exposures of the object.', "E_EXPOSURES", "exposures",
    ),
    "not_reciprocal": Row(
        "refuse", "the counts are not proportional to the exposure", "rms deviation {number:.1%}, {subject}", "at most {limit:.1%} rms",
        "Capture object and white with the same exposure, or an exposure series of the white with a dark for each time.",
        "E_EXPOSURES", "exposures",
    ),
    "linearity_unknown": Row(
        "refuse", "the linearity cannot be checked", "no scene lies between 5 and 95 % of saturation in two exposures",
        "three exposures or more of the white, a factor of two apart", error="E_EXPOSURES", field="exposures",
    ),
    "saturation_unknown": Row(
        "refuse", "merging exposures needs a saturation level", advice="Declare `bits` or `saturation`.", error="E_VALUE",
        field="cameras.{camera}.saturation",
    ),
    "not_scaled": Row(
        "doubt", "white and object have different exposures, and without a series the linearity is unknown", "{subject}",
        advice="Capture both with one exposure, or a series of the white",
    ),
    "bend": Row(
        "doubt", "the sensor is not linear: by its exposure series its brightest values are off dim ones", "{number:+.2%} of the light",
        advice="Nothing is corrected: values may be off by as much, unless the files are linearised before",
    ),
    "offset": Row(
        "doubt", "without light the exposure series have other counts than the dark", "{number:+.1f} ± {limit:.2g} counts",
        advice="The darks are of another temperature or setting, or the response bends at its dark end: dark paint is off by as much. "
        "Capture darks beside the object",
    ),
    "black_by_series": Row(
        "note", "the black level is taken from exposures of one scene: darks of one time alone do not show it",
        "{number:.1f} ± {limit:.1f} counts", advice="`black` in campaign.toml states it",
    ),
    # darks
    "black_unclear": Row(
        "refuse", "the black levels of the file cannot be understood", "{subject}", "levels of every sensel of the frame",
        "Capture darks, or write `black` under [cameras.{camera}] where one number serves.", "E_VALUE", "BlackLevel",
    ),
    "clipped_too_much": Row(
        "refuse", "the darks are clipped too strongly to measure the black level", "{number:.1%} zeros, {limit:.0f} pixels above",
        "30 pixels at 2 to 4 counts or more",
        "Raise the camera's black level (offset) by some counts, or capture an exposure series of a lit scene.", "E_DARK_CLIPPED",
    ),
    "darks_clipped": Row(
        "note", "darks were clipped at zero and are fitted as censored", "black {subject} counts, noise {limit:.2g}; zeros in {number:.0%}",
    ),
    "darks_lost": Row(
        "doubt", "darks are clipped so strongly that what the black level hides is unknown", "{number:.0%} zeros {subject}",
        advice="Dark values may be wrong by it: raise the camera's black level (offset)",
    ),
    "black_wanders": Row(
        "doubt", "the black level wanders from dark to dark", "values are known to {number:.2g} by it ({subject})",
        advice="It is common to all pixels, and sigma does not include it",
    ),
    # the white
    "white_dark": Row(
        "refuse", "the white is not above the dark{subject}", "white {number:g}, dark {limit:g} counts, medians", "white above dark",
        NO_LIGHT, "E_WHITE_DARK",
    ),
    "white_swapped": Row(
        "refuse", "the white is not above the dark{subject}", "white {number:g}, dark {limit:g} counts, medians", "white above dark",
        "Dark and white appear to be swapped: exchange their names in campaign.toml.", "E_WHITE_DARK",
    ),
    "white_saturated": Row(
        "refuse", "the white{subject} is saturated", "{number:.0%} of its pixels", "less than {limit:.0%}",
        "Capture the white with a shorter exposure.", "E_WHITE_SATURATED",
    ),
    "white_beyond": Row(
        "refuse", "the white{subject} is saturated", "{number:.0%} of its pixels, with codes that go on above the saturation",
        "less than {limit:.0%}", "Correct `bits` or `saturation`, or capture the white in the object's mode.", "E_WHITE_SATURATED",
    ),
    "quiet_white": Row(
        "doubt", "the white has no more noise than the dark, and light has shot noise: it is averaged, or full (saturated)",
        "{number:g} counts", advice="If it is full declare `saturation`, and capture it with less exposure",
    ),
    "full_scale": Row(
        "note", "the sensor is full (saturated) where its frames show it", "{number:g} counts, {subject}",
        advice="Values from there on are flagged; `saturation` in campaign.toml states it",
    ),
    "board_differs": Row(
        "refuse", "the reflectance of the white does not match the bands", "{subject}", "one positive number, or {limit:.0f}",
        error="E_VALUE", field="white.reflectance",
    ),
    "scale_used": Row(
        "note", "the file states the values of reflectance 1.0, and has neither dark nor white", "{subject}",
        advice='Its values are taken as reflectance; if they are raw, write `overrule = ["reflectance_scale"]`',
    ),
    "scale_unused": Row("note", "the file states the values of reflectance 1.0, which is not used", "{subject}"),
    "no_white": Row("note", "no white is declared: the cube remains in counts"),
    "white_unknown": Row(
        "doubt", "the reflectance of the white is assumed to be 1 at every wavelength",
        advice="Give it, or a CSV of its spectrum, in targets.white.reflectance",
    ),
    # noise
    "single_shots": Row(
        "doubt", "noise is estimated from the smooth parts of single shots, and sigma is no surer than these", advice=FEW_SHOTS
    ),
    "no_sigma": Row("doubt", "noise cannot be measured by these frames: the layer has no sigma", advice=FEW_SHOTS),
    "unlike_bands": Row(
        "doubt", "at like signal the variance of the noise differs from band to band: gain or black level is another, or shots differ",
        "by a factor of {number:.2g} at {subject}", advice="Their sigma is by their own shots. Capture all bands with one setting",
    ),
    "unlike_channels": Row(
        "doubt", "at like signal the variance of the noise differs from band to band: channels were multiplied, as a white balance does",
        "by a factor of {number:.2g} at {subject}", advice="Sigma there is off by its root. Export raw frames without white balance",
    ),
    # light
    "lamp": Row(
        "doubt", "the lamp changed between white and object", "known to {number:.2%} (one standard deviation; {subject})",
        advice="It is common to all pixels, and sigma does not include it. Let lamps warm up, and capture whites before and after the "
        "object with the time in their files",
    ),
    "object_dark": Row(
        "refuse", "the object has no light", "no more than {number:.0%} of the pixels of any band above the dark, as noise alone gives",
        "frames that the lamp lit", NO_LIGHT, "E_NO_LIGHT",
    ),
    "bands_dark": Row("doubt", "the object has no light in some bands, nothing above its dark but noise", "{subject}", advice=NO_LIGHT),
    "above_white": Row(
        "doubt", "the object is brighter than a perfect white", "{number:.2%} of it in {subject}",
        advice="Check that white and object had one light, exposure and setting",
    ),
    "below_dark": Row(
        "doubt", "the object is darker than its dark by more than noise", "{number:.2%} of it in {subject}",
        advice="The dark was warmer or longer than the object, or saw light. Capture darks beside the object",
    ),
    "trap_beyond": Row(
        "refuse", "a light trap lies beyond the frame", error="E_VALUE", field="targets.traps.{subject}",
        expected="[x, y, width, height] within the frame, native px",
    ),
    # what cannot be made of frames
    "dark_time": Row(
        "refuse", "the dark of another time does not serve frames of {limit:g} s: the black level is unknown",
        "dark current of up to {number:.2g} counts, noise of {subject}", "a dark of the same time, darks of two times, or the black level",
        "Capture darks of {limit:g} s, or write `black` of the camera in campaign.toml: what a dark of a very short time shows.",
        "E_EXPOSURES", "black",
    ),
    "white_object": Row(
        "refuse", "the white shows the object, not a white board", "the detail of the object over {number:.0%} of the frame",
        "a smooth board that fills the view",
        "Check that the frames of white and object are not the same, and capture a white board in place of the object.", "E_WHITE_DETAIL",
    ),
    "white_picture": Row(
        "refuse", "the white is a picture, not a white board",
        "detail of {number:.0%} rms over more than half of the frame that the object does not have", "a smooth board that fills the view",
        "Capture a white board in place of what the white shows, or exchange the names of white and object.", "E_WHITE_DETAIL",
    ),
    "many_defects": Row(
        "refuse", "too many sensels appear defective", "{number:.1%}", "at most {limit:.0%}",
        "Check the dark and the white: the pattern may be wrong, or a frame damaged.", "E_VALUE",
    ),
    "mosaic_small": Row("refuse", "the mosaic is too small", "{subject}", "at least that many whole periods of its pattern", error="E_SIZE"),
    "not_bayer": Row(
        "refuse", "this demosaicing needs a Bayer pattern", "a pattern of {subject}", "2x2, one of three channels on a diagonal",
        'Use demosaic = "normalised".', "E_VALUE", "demosaic",
    ),
    "demosaicing": Row("refuse", "unknown demosaicing method", "{subject}", error="E_VALUE", field="demosaic"),
    "no_phase": Row(
        "refuse", "no phase of the mosaic has a signal", "median {number:.2g} counts", "light",
        "Use a longer exposure for this band.", "E_VALUE",
    ),
    "few_spectra": Row(
        "refuse", "too few spectra or bands for a signal subspace", "{number:.0f} spectra with {subject} bands",
        "3 or more bands, {limit:.0f} spectra per band", "Remove `denoise` for this camera.", "E_SIZE", "denoise",
    ),
    "noise_correlated": Row(
        "refuse", "noise and signal cannot be separated: the noise of neighbouring bands is correlated, or there are too few bands",
        "excess correlation {number:.2f}, {subject} dimensions", "within ±{limit:g}, at most half of the dimensions",
        "Remove `denoise` for this camera.", "E_CORRELATED", "denoise",
    ),
    "trap_blind": Row("note", "light traps show nothing: stray light is not known by them", "{subject}"),
}  # fmt: skip
