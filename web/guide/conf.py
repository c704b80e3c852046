"""Configuration of the guide: Sphinx with the product's own look, and no file of another host.

The pages are Markdown (MyST); glossary and reference are written from their one source.
"""

import shutil
from importlib import metadata
from pathlib import Path

from sphinx.application import Sphinx

from spheremark.web.glossary import anchor, glossary

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
MADE = HERE / "made"

project = "spheremark"
release = metadata.version("spheremark")
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3
exclude_patterns = ["templates", "site"]
templates_path = ["templates"]
html_theme = "basic"
html_static_path = [
    "../static/tokens.css",
    "../static/site.css",
    "../static/theme.js",
    "../static/guide.css",
]
html_css_files = ["tokens.css", "site.css", "guide.css"]
html_js_files = [("theme.js", {"priority": 100})]
html_extra_path = ["made/pictures"] if (MADE / "pictures").is_dir() else []
html_copy_source = False
html_use_index = False
pygments_style = "friendly"
numpydoc_show_class_members = False
autodoc_typehints = "none"
autodoc_preserve_defaults = True  # the names of defaults, not their values
suppress_warnings = ["image.not_readable", "myst.xref_missing"]


def _write(name: str, text: str) -> None:
    """Write a page that is made, where it changed."""
    path = MADE / name
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def _glossary_page() -> str:
    """Return the glossary as Markdown."""
    terms = (f"({anchor(word)})=\n{word}\n: {text}\n" for word, text in glossary().items())
    return "# Glossary\n\n" + "\n".join(terms)


def _copy_fonts(app: Sphinx, error: Exception | None) -> None:
    """Put the fonts beside the styles that name them."""
    if error is None:
        fonts = Path(app.outdir) / "_static/fonts"
        shutil.copytree(ROOT / "web/static/fonts", fonts, dirs_exist_ok=True)


def setup(app: Sphinx) -> None:
    """Write the pages that are made, and copy the fonts at the end."""
    _write("glossary.md", _glossary_page())
    _write("commands.md", (ROOT / "REFERENCE.md").read_text())
    _write("conventions.md", (ROOT / "CONVENTIONS.md").read_text())
    app.connect("build-finished", _copy_fonts)
