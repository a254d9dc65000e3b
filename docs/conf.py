"""How Sphinx makes the site: ``make docs``."""

from __future__ import annotations

import warnings
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.util import inspect

# TorchRL 0.14's own collectors warn about themselves on import.
warnings.filterwarnings("ignore", ".*inherits from WeightUpdaterBase.*", DeprecationWarning)

project = "torchrl_ecpo"
author = "the torchrl_ecpo authors"
version = release = installed_version("torchrl-ecpo")

copyright = "2026 " + author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"{project} {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = (
    4  # links like searches.md#the-search-behind-the-first-study, as GitHub has them
)

autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
add_module_names = False
default_role = "code"  # what stands in single backquotes
python_use_unqualified_type_names = True
python_display_short_literal_types = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True

nitpicky = True
# Types of other projects, and the short names by which annotations call them.
nitpick_ignore_regex = [
    (
        "py:.*",
        r"(collections|gymnasium|hydra|matplotlib|numpy|omegaconf|pathlib|tensordict|torch|torchrl|types|typing)"
        r"\..*",
    ),
    (
        "py:(class|exc)",
        "Actions|Axes|CheckpointError|EnvBase|HydraException|NestedKey|Score|Tensor|TensorDictBase",
    ),
    ("py:class", r"torchrl_ecpo\..*\._.+"),  # what is private has no page
    ("py:class", r"torchrl_ecpo\.modules\.(histories|distinct)\..+"),  # nor have distinct pasts
    ("py:attr", "in_keys|loss_mask_key|losses|metrics|out_keys"),  # of every loss
]


def name_folders(app: Sphinx, page: nodes.document) -> None:
    """Let a link to a folder of the repository, which a site cannot show, be its name."""
    for link in list(page.findall(pending_xref)):
        folder = Path(app.env.doc2path(link.get("refdoc", "index"))).parent / link["reftarget"]
        if link["reftype"] == "myst" and folder.is_dir():
            link.replace_self(link.children)


def signature_of_init(
    app: Sphinx, what: str, name: str, found: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Show the arguments of a constructor that a metaclass of TorchRL hides."""
    if what != "class" or signature != "(*args, **kwargs)":
        return None
    arguments = inspect.signature(found.__init__, bound_method=True)
    text = inspect.stringify_signature(
        arguments,
        show_return_annotation=False,
        unqualified_typehints=True,
        short_literals=python_display_short_literal_types,
    )
    return text, returns


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", signature_of_init)
    app.connect("doctree-read", name_folders)
