"""Sphinx configuration."""

import re

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
    "sphinxcontrib.bibtex",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
bibtex_bibfiles = ["references.bib"]
bibtex_reference_style = "author_year"
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "Levkas"


def cite(app, what, name, obj, options, lines):
    """Turn citations of docstrings, ``[key]_``, into those of references.bib."""
    lines[:] = [re.sub(r"\[([a-z]+\d{4})\]_", r":cite:t:`\1`", line) for line in lines]


def setup(app):
    """Connect what is done to docstrings."""
    app.connect("autodoc-process-docstring", cite)
