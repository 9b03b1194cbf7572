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
# Browsers let no page of a disk fetch another one: excerpts of the pages that are found would fail there.
html_show_search_summary = False

NAVIGATION_DEPTH = 3


def cite(app, what, name, obj, options, lines):
    """Turn citations of docstrings, ``[key]_``, into those of references.bib."""
    lines[:] = [re.sub(r"\[([a-z]+\d{4})\]_", r":cite:t:`\1`", line) for line in lines]


def shorten_navigation(app, page, template, context, doctree):
    """Limit the navigation beside every page: with all modules in it, it takes half of the build."""
    whole = context.get("toctree")
    if whole:
        context["toctree"] = lambda **options: whole(**{**options, "maxdepth": NAVIGATION_DEPTH})


def setup(app):
    """Connect what is done to docstrings and to pages; the theme reads the navigation at priority 500."""
    app.connect("autodoc-process-docstring", cite)
    app.connect("html-page-context", shorten_navigation, priority=400)
