"""Files that pages load, and the addresses that change when they do."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from importlib import metadata, resources
from pathlib import Path

from markupsafe import Markup

STATIC = "/static"
_FONT = re.compile(r'url\("(fonts/[^"]+)"\)')
_TOKEN = re.compile(r"(--[\w-]+): ([^;]+);")


def static_folder() -> Path:
    """Return the folder that is served at ``/static``."""
    return Path(str(resources.files("spheremark.web"))) / "static"


def plotly_script() -> Path:
    """Return Plotly's script, as the installed package brings it."""
    return Path(str(resources.files("plotly"))) / "package_data" / "plotly.min.js"


def plotly_url() -> str:
    """Return the address of Plotly's script: another one for each version."""
    return f"{STATIC}/plotly-{metadata.version('plotly')}.min.js"


@cache
def digest() -> str:
    """Return a short digest of all own static files."""
    total = hashlib.sha256()
    for path in sorted(static_folder().rglob("*")):
        if path.is_file():
            total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()[:12]


def url(name: str) -> str:
    """Return the address of an own static file, with what makes it new when any has changed."""
    return f"{STATIC}/{name}?v={digest()}"


@cache
def map_style_id() -> str:
    """Return the id under which Plotly looks for the style sheet of its maps.

    We draw none: an element of that id keeps 80 kB of inline style out of every page.
    """
    found = re.search(r'getElementById\("([0-9a-f]{64})"\)', plotly_script().read_text("utf-8"))
    return found[1] if found else "no-map-style"


def inline_styles() -> Markup:
    """Return all own styles, fonts included, for a page that stands alone."""
    folder = static_folder()
    text = "".join((folder / name).read_text("utf-8") for name in ("tokens.css", "site.css"))
    return Markup(_FONT.sub(lambda found: _data_url(folder / found[1]), text))


def inline_script(name: str) -> Markup:
    """Return an own script for a page that stands alone."""
    return Markup((static_folder() / name).read_text("utf-8"))


def tokens(mode: str) -> dict[str, str]:
    """Return the colour of each token in light or dark."""
    text = (static_folder() / "tokens.css").read_text("utf-8")
    light, _, dark = text.partition(':root[data-theme="dark"]')
    found = dict(_TOKEN.findall(light))
    return found if mode == "light" else found | dict(_TOKEN.findall(dark))


def _data_url(path: Path) -> str:
    """Return a font as an address that holds it."""
    return f'url("data:font/woff2;base64,{base64.b64encode(path.read_bytes()).decode()}")'
