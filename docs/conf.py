"""Sphinx: build with ``sphinx-build -W docs docs/_build``, having installed the extra docs."""

from hmsa_ros import __version__

project = 'hmsa_ros'
author = 'hmsa_ros maintainers'
release = version = __version__

extensions = ['myst_parser', 'numpydoc', 'sphinx.ext.autodoc']
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
exclude_patterns = ['_build']
numpydoc_show_class_members = False
html_theme = 'alabaster'
