# SPDX-License-Identifier: Apache-2.0
"""Settings of Sphinx: `make docs` builds the pages of this folder; rosdoc2 takes them too."""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fhaosmo_ros import __version__

project = 'fhaosmo_ros'
author = 'fhaosmo_ros maintainers'
copyright = author  # noqa: A001
version = release = __version__
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.mathjax', 'sphinx.ext.napoleon']
source_suffix = {'.md': 'markdown'}
root_doc = 'index'
exclude_patterns = ['_build']
html_theme = 'sphinx_rtd_theme'
html_copy_source = False
html_static_path = ['_static']
html_css_files = ['site.css']
myst_heading_anchors = 4
# The pages are read in the repository too, with links to files that are no pages.
myst_enable_extensions = ['dollarmath', 'fieldlist']
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings say types, shapes and units
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
