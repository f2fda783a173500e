"""The documentation: python -m sphinx -W --keep-going -b html docs docs/_build/html."""

import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

project = "minimax-cal"
author = "the minimax-cal authors"
copyright = author
version = release = metadata.version("minimax-cal")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_click",
    "sphinx_gallery.gen_gallery",
    "contents",
    "math_svg",
    "plain_docstrings",
]
exclude_patterns = ["_build", "_ext", "examples/GALLERY_HEADER.rst"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
html_math_renderer = "svg"
smartquotes = False  # options keep both of their dashes
default_role = "literal"
toc_object_entries = False  # the list of pages holds pages; a third of the building time

html_theme = "furo"
html_title = f"minimax-cal {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
pygments_style = "friendly"
pygments_dark_style = "native"

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"Array": "Array", "Matrix": "Matrix"}
maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

# These examples are run at each build; what else lies beside them is not for the gallery.
executed_examples = "calibrate_and_judge|diagnose_a_gap|tracker_to_report|papers_compared"
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "examples",
    "filename_pattern": rf"({executed_examples})\.py$",
    "ignore_pattern": rf"^(?!.*({executed_examples})\.py$)",
    "within_subsection_order": "FileNameSortKey",
    "reference_url": {"minimax_cal": None},
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
}
