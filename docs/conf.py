"""Configuration of Sphinx: ``sphinx-build -W docs docs/_build`` makes the site."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import glintbsdf  # noqa: E402

project = "glintbsdf"
author = "the glintbsdf developers"
release = glintbsdf.__version__

extensions = [
    "pictures",
    "plugin_pages",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",  # mathematics without a network
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_tabs.tabs",
    "sphinxcontrib.bibtex",
]
bibtex_bibfiles = ["references.bib"]
# Tutorials run when the site is built. An error in one is an error of the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
suppress_warnings = ["myst.header"]  # what is included of the README begins at its second level
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
copybutton_exclude = ".linenos, .gp"
sphinx_tabs_disable_tab_closing = True
exclude_patterns = ["_build", "jupyter_execute", "images/README.md"]

html_theme = "furo"
html_title = f"glintbsdf {release}"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_copyright = False

# Roles and substitutions of the plugins' docstrings, which are those of Mitsuba's documentation.
rst_prolog = """
.. role:: monosp(literal)
.. role:: paramtype(literal)

.. |string| replace:: :paramtype:`string`
.. |float| replace:: :paramtype:`float`
.. |int| replace:: :paramtype:`integer`
.. |bool| replace:: :paramtype:`boolean`
.. |true| replace:: :monosp:`true`
.. |false| replace:: :monosp:`false`
.. |spectrum| replace:: :paramtype:`spectrum`
.. |texture| replace:: :paramtype:`texture`
.. |tensor| replace:: :paramtype:`tensor`
.. |transform| replace:: :paramtype:`transform`
.. |exposed| replace:: :abbr:`P (exposed as a scene parameter)`
.. |differentiable| replace:: :abbr:`∂ (differentiable)`
.. |discontinuous| replace:: :abbr:`D (moves discontinuities, of which derivatives know nothing)`
"""
