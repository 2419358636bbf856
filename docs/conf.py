"""Sphinx configuration of the documentation site: `make docs` builds it, with warnings as errors."""

import importlib.metadata
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "armident"
author = "armident"
release = importlib.metadata.version("armident")
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "generated_reference",
]
exclude_patterns = ["extensions", "README.md"]
html_theme = "furo"
html_title = "armident"
html_copy_source = False

# Headings have anchors as on code hosting sites, so that a link works in both places.
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "colon_fence"]
# The examples run in tests, where the recordings are; the site shows their source.
nb_execution_mode = "off"

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = False
napoleon_use_rtype = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
