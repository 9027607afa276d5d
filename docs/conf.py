"""Settings of the documentation site: `make docs` builds it into docs/_build/html.

The source directory is the root of the project: pages link README, ARCHITECTURE and benchmarks as they do on GitHub.
"""

from __future__ import annotations

import sys
from pathlib import Path

from ipython_pygments_lexers import IPython3Lexer
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs"), str(ROOT / "benchmarks")]

from api_pages import write_api_pages  # noqa: E402
from gallery import write_gallery  # noqa: E402
from plots import write_plots  # noqa: E402

from giantlike.core.version import VERSION  # noqa: E402

project = "giantlike"
author = "The giantlike developers"
copyright = author
version = release = VERSION

root_doc = "docs/index"
include_patterns = ["*.md", "docs/**", "benchmarks/*.md", "benchmarks/results/*.md"]
exclude_patterns = [
    ".*",
    "docs/_build",
    "docs/_templates",
    "**/.ipynb_checkpoints",
    # Folders without pages, so that they are not searched for any.
    *("build", "dist", "catalogs", "demo-output", "examples", "giantlike", "ray_tracing", "runs", "shapes", "tests"),
]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "numpydoc"]


nb_execution_mode = "off"  # notebooks are shown with the outputs that are stored in them
nb_merge_streams = True
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4

autosummary_generate = False
autodoc_typehints = "none"  # the docstrings have types with shapes, units and frames
autodoc_preserve_defaults = True
autodoc_member_order = "groupwise"
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = f"giantlike {VERSION}"
html_short_title = "giantlike"
html_additional_pages = {"index": "to_root.html"}
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "giantlike"},
    "show_toc_level": 2,
    "navigation_with_keys": True,
    "header_links_before_dropdown": 7,
    "navbar_align": "left",
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
    "pygments_light_style": "tango",
    "pygments_dark_style": "monokai",
}


def setup(app: Sphinx) -> None:
    """Make the pages that are not kept in git before Sphinx looks for pages."""
    app.connect("builder-inited", _make_pages)
    app.add_lexer("python", IPython3Lexer)  # Python, and the shell lines of notebooks


def _make_pages(app: Sphinx) -> None:
    write_api_pages(ROOT / "docs" / "api")
    write_gallery(ROOT / "docs" / "gallery")
    write_plots(ROOT / "docs" / "plots")
