"""Sphinx configuration."""

import inspect

from sphinx.util.inspect import stringify_signature

project = "torchrl_ficreg"
author = "The torchrl_ficreg authors"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
exclude_patterns = ["gradient_flow.rst"]  # included by nutshell.rst
html_theme = "alabaster"
html_theme_options = {"page_width": "1240px", "body_max_width": "none"}  # for tables of seven columns and long commands
nitpicky = False


def show_constructor(app, what, name, obj, options, signature, returns):
    """Metaclasses of PyTorch and TorchRL hide the arguments of a class behind ``(*args, **kwargs)``."""
    if what == "class" and signature is not None and signature.startswith("(*args, "):
        own = inspect.signature(obj.__init__)
        own = own.replace(parameters=list(own.parameters.values())[1:])  # without self
        return stringify_signature(own, show_annotation=False, show_return_annotation=False), None


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", show_constructor)
