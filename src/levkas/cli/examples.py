"""Two command lines for each command, as its help shows them."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "agree": ("levkas agree icons-2019 icons-2026", "levkas agree ours theirs --object icon1 -o agreement"),
    "build": ("levkas build icons", "levkas build icons --object icon1"),
    "chart": ("levkas chart icons", "levkas chart cube.hdr --kind ColorCheckerSG -o chart.html"),
    "demo": ("levkas demo", "levkas demo trial --seed 7"),
    "doctor": ("levkas doctor", "levkas doctor /data/icons"),
    "estimate": ("levkas estimate icons/database", "levkas estimate icons/database --from d80 --to lctf-vis -o estimation"),
    "estimate apply": (
        "levkas estimate apply icons/database estimation/models/d80_matern.npz vis-estimated",
        "levkas estimate apply icons/database d80_wiener.npz vis-estimated --object icon2",
    ),
    "evaluate": ("levkas evaluate icons", "levkas evaluate icons --points checks.csv"),
    "export": ("levkas export icons --for envi", "levkas export icons --for qgis --object icon1 --camera d80 -o out"),
    "inspect": ("levkas inspect icons", "levkas inspect icons --port 8800 --no-open"),
    "look": ("levkas look captures", "levkas look captures --write"),
    "map": (
        "levkas map icons/database icon1 points.csv --from grid --to xray",
        "levkas map icons/database icon1 points.csv --from d80:R --to grid -o mapped.csv",
    ),
    "plan exposure": ("levkas plan exposure white.NEF", "levkas plan exposure --setup studio.toml -o exposure.html"),
    "plan framing": ("levkas plan framing studio.toml", "levkas plan framing studio.toml --json"),
    "plan light": ("levkas plan light studio.toml", "levkas plan light studio.toml --optimise -o light.html"),
    "publish": ("levkas publish icons --check", "levkas publish icons -o published --url https://example.org/icons"),
    "radiometry": ("levkas radiometry icons", "levkas radiometry icons --camera d80 -o radiometry.html"),
    "simulate": ("levkas simulate trial", "levkas simulate trial --preset small --objects 2"),
    "status": ("levkas status icons",),
    "validate": ("levkas validate icons/database", "levkas validate https://example.org/icons"),
    "watch": ("levkas watch session", "levkas watch session --once --json"),
}  # fmt: skip
"""Command → command lines that parse; the first is what most people type."""
