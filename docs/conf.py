"""Sphinx configuration."""

import re

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform

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


class LinkNames(SphinxPostTransform):
    """Lead from every literal that is a documented name, ``levkas.open`` or ``read_stiff(…)``, to its entry."""

    default_priority = 5
    PUBLIC = frozenset(n for n in levkas.__all__ if "_" in n or n[0].isupper())
    """Names that need no ``levkas.`` before them: ``build`` and ``open`` are words as well."""

    def run(self, **kwargs):
        """Wrap each such literal of a text in a reference; what it does not find stays as it is."""
        for literal in list(self.document.findall(nodes.literal)):
            name = re.match(r"(\w+\.)*\w+(?=\(|$)", literal.astext())
            if name and isinstance(literal.parent, nodes.paragraph | nodes.term):
                place = {"refdoc": self.env.docname, "refdomain": "py", "reftype": "obj"}
                whole = f"levkas.{name[0]}" if name[0] in self.PUBLIC else name[0]
                if whole.startswith("levkas."):
                    found = addnodes.pending_xref("", literal.deepcopy(), reftarget=whole, **place)
                    literal.replace_self(found)


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
    app.add_post_transform(LinkNames)
    app.connect("autodoc-process-docstring", cite)
    app.connect("html-page-context", shorten_navigation, priority=400)
