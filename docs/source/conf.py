"""Sphinx configuration."""

project = "torchrl_ficreg"
author = "The torchrl_ficreg authors"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
exclude_patterns = ["gradient_flow.rst"]  # included by nutshell.rst
html_theme = "alabaster"
html_theme_options = {"page_width": "1240px", "body_max_width": "none"}  # for tables of seven columns and long commands
nitpicky = False
