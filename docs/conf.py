"""Sphinx settings of the documentation; `make docs` builds it, offline, with warnings as errors."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent / "_ext"), str(Path(__file__).parent.parent)]

from latentplan import __version__  # noqa: E402

project = "latentplan"
copyright = "the latentplan authors, MIT licence"
release = version = __version__
html_title = f"latentplan {__version__}"

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_parser", "sphinx_copybutton", "reference_pages"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "_ext", "_static", "**/__pycache__"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
default_role = "literal"
suppress_warnings = ["ref.python"]  # a name that a package exports is found in the package and in its module
add_module_names = False
toc_object_entries = False
python_display_short_literal_types = True
maximum_signature_line_length = 88

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
pygments_style = "friendly"
highlight_language = "none"
copybutton_prompt_text = r"\$ "
copybutton_prompt_is_regexp = True
