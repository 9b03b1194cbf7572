"""Sphinx configuration."""

import levkas

project = "Levkas"
author = "The Levkas authors"
copyright = "2026, the Levkas authors"
release = version = levkas.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "Levkas"
