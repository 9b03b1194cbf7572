"""Names of colour charts in the languages that studios use."""

from __future__ import annotations

CLASSIC = """
    chart charts colorchecker colourchecker colorchart colourchart macbeth passport xrite calibrite farbkarte farbtafel
    farbkontrollkarte charte mire nuancier cartacolori scalacolori cartadecolor kleurenkaart
"""
CHARTS = {
    **dict.fromkeys(CLASSIC.split(), "ColorChecker24"),
    **dict.fromkeys(["ccsg", "digitalsg", "colorcheckersg", "colourcheckersg"], "ColorCheckerSG"),
}
"""Words in names, and the reference that each most likely is."""
NAMES = {
    **dict.fromkeys(("colorchecker24", "colorcheckerclassic", "classic", "cc24"), "ColorChecker24"),
    **dict.fromkeys(("colorcheckerdigitalsg", "sg", "sg140"), "ColorCheckerSG"),
}
"""Names of charts beside the words that files are named by."""

SPANS = {"ColorChecker24": (380.0, 730.0)}
"""nm over which a chart's reflectances are built in: BabelColor's average ends where handheld spectrophotometers do."""
NEAR_NM = 5.0
"""A band this near to the end of a chart's spectra takes their last value."""


def kind_of_chart(name: str) -> str | None:
    """Return the chart that a name means; spaces, hyphens and case do not matter. None for no chart.

    >>> kind_of_chart("colour-checker SG"), kind_of_chart("Farbkarte"), kind_of_chart("icon")
    ('ColorCheckerSG', 'ColorChecker24', None)
    """
    plain = "".join(c for c in name.lower() if c.isalnum())
    for word in (plain, plain.replace("colour", "color")):
        if kind := NAMES.get(word) or CHARTS.get(word):
            return kind
    return None
