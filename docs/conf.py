"""Sphinx: python -m sphinx -W docs docs/_build/html. Nothing is fetched, neither here nor by the pages."""

import re
import shutil
import sys
import zlib
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from rcorefine.version import __version__  # noqa: E402

project, author, version, release = "rcorefine", "rcorefine developers", __version__, __version__
project_copyright = "rcorefine developers"
extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "mathml",
]
html_math_renderer = "mathml"
exclude_patterns = ["_build", "coursework/solutions"]
templates_path = ["_templates"]
html_theme = "pydata_sphinx_theme"
html_title = f"rcorefine {__version__}"
html_static_path = ["_static"]
html_sidebars = {name: [] for name in ("start", "howto", "paper", "readme", "changelog")}  # no pages below
html_css_files = ["site.css"]
html_show_sourcelink = False
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 9,
    "footer_start": ["copyright"],
    "footer_end": [],
    "use_edit_page_button": False,
}

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # notebooks are shown as they were run
nb_merge_streams = True
nb_render_image_options = {"alt": "What this code draws"}
linkcheck_ignore = [r"https?://"]  # -b linkcheck tests files; -W missing pages, anchors and names
default_role = "py:obj"
autosummary_generate = True
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
suppress_warnings = ["ref.python"]  # Result.report is inherited by many

#: What the docstrings name of other packages, as their own inventories list it: written here, not fetched.
_NAMES = {
    "control": (
        "https://python-control.readthedocs.io/en/latest/",
        "generated/control.{name}.html",
        ["StateSpace", "TransferFunction", "FrequencyResponseData", "TimeResponseData", "ControlPlot",
         "NonlinearIOSystem", "ControlArgument", "ControlDimension", "bode_plot", "feedback", "ss", "nlsys"],
    ),
    "numpy": ("https://numpy.org/doc/stable/", "reference/generated/numpy.{name}.html", ["ndarray"]),
    "scipy": ("https://docs.scipy.org/doc/scipy/", "reference/generated/scipy.{name}.html", ["signal.csd"]),
    "matplotlib": ("https://matplotlib.org/stable/", "api/_as_gen/matplotlib.{name}.html", ["pyplot.figure"]),
}  # fmt: skip


def _inventory(package, pattern, names):
    """An inventory file in Sphinx's format (version 2)."""
    lines = [f"{package}.{name} py:class 1 {pattern.format(name=name)} -\n" for name in names]
    head = f"# Sphinx inventory version 2\n# Project: {package}\n# Version: \n"
    head += "# The remainder of this file is compressed using zlib.\n"
    path = HERE / "_build" / "inventories" / f"{package}.inv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head.encode() + zlib.compress("".join(lines).encode()))
    return str(path)


intersphinx_mapping = {
    package: (address, _inventory(package, pattern, names))
    for package, (address, pattern, names) in _NAMES.items()
}


def _pages(app):
    import gallery

    gallery.write(HERE / "gallery")
    shown = HERE / "notebooks"
    shutil.rmtree(shown, ignore_errors=True)
    shown.mkdir()
    for notebook in HERE.parent.glob("notebooks/*.ipynb"):
        shutil.copy2(notebook, shown)  # with its date, by which Sphinx knows what to read again


#: Links as they stand in the repository, and where they lead on the site; marks of the formatter.
_MOVED = [
    (r"\]\((?:\.\./)*notebooks/(\d\d_\w+)\.(?:py|ipynb)\)", r"](notebooks/\1.ipynb)"),
    (r"\]\(((?:\.\./)*)\.\./README\.md", r"](\1readme.md"),
    (r"  # fmt: skip", ""),
]
_MOVED_OF_README = [
    (r"\]\(docs/", "]("),
    (r"\]\(CHANGELOG\.md", "](changelog.md"),
    (r"\[Contribute\]\(CONTRIBUTING\.md\)", "Contribute: `CONTRIBUTING.md`"),
    (r"\]\((notebooks/(?!\d\d_)|LICENSE)", r"](../\1"),
]


def _links(app, name, source):
    if name == "readme":
        source[0] = HERE.parent.joinpath("README.md").read_text(encoding="utf-8")
    for there, here in (_MOVED_OF_README if name == "readme" else []) + _MOVED:
        source[0] = re.sub(there, here, source[0])


def setup(app):
    """Make the generated pages before Sphinx looks for pages."""
    app.connect("config-inited", lambda app, config: _pages(app))
    app.connect("source-read", _links)
