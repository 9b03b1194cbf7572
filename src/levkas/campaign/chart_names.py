"""Names of colour charts in the languages that studios use."""

CLASSIC = """
    chart charts colorchecker colourchecker colorchart colourchart macbeth passport xrite calibrite farbkarte farbtafel
    farbkontrollkarte charte mire nuancier cartacolori scalacolori cartadecolor kleurenkaart
"""
CHARTS = {
    **dict.fromkeys(CLASSIC.split(), "ColorChecker24"),
    **dict.fromkeys(["ccsg", "digitalsg", "colorcheckersg", "colourcheckersg"], "ColorCheckerSG"),
}
"""Words in names, and the reference that each most likely is."""
