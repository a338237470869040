"""Sphinx: ``make docs`` builds the pages, with warnings as errors."""

from pathlib import Path
import sys

sys.path[:0] = [str(Path(__file__).parent.parent), str(Path(__file__).parent / '_ext')]

from hmsa import __version__  # noqa: E402

project = 'hmsa_ros'
author = 'hmsa_ros maintainers'
copyright = author
release = version = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'numpydoc', 'mathml', 'reference', 'words']
exclude_patterns = ['_build']
nitpicky = False

myst_enable_extensions = ['amsmath', 'dollarmath', 'colon_fence']
myst_heading_anchors = 3

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
numpydoc_show_class_members = False
html_theme = 'furo'
html_title = 'hmsa_ros'
html_static_path = ['_static']
html_css_files = ['hmsa.css']
html_math_renderer = 'mathml'
html_copy_source = False
html_show_sphinx = False
pygments_style = 'friendly'
pygments_dark_style = 'monokai'
