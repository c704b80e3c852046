"""Static files of pages, with addresses that change with their content."""

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
_IMPORT = re.compile(r'from "\./([\w-]+\.js)"')
_TOKEN = re.compile(r"(--[\w-]+): ([^;]+);")


def static_folder() -> Path:
    """Return the folder that is served at ``/static``."""
    return Path(str(resources.files("spheremark.web"))) / "static"


def guide_folder() -> Path:
    """Return the folder of the guide, which exists once ``make docs`` has built it."""
    return Path(str(resources.files("spheremark.web"))) / "guide" / "site"


def plotly_script() -> Path:
    """Return the path of Plotly's script in the installed package."""
    return Path(str(resources.files("plotly"))) / "package_data" / "plotly.min.js"


def plotly_url() -> str:
    """Return the address of Plotly's script, which changes with its version."""
    return f"{STATIC}/plotly-{metadata.version('plotly')}.min.js"


def reference_folder() -> Path:
    """Return the folder of Swagger UI in the installed package."""
    return Path(str(resources.files("fastapi_offline"))) / "static"


def reference_urls() -> dict[str, str]:
    """Return the addresses of Swagger UI's files, which change with its version."""
    folder = f"{STATIC}/swagger-{metadata.version('fastapi-offline')}"
    return {"script": f"{folder}/swagger-ui-bundle.js", "style": f"{folder}/swagger-ui.css"}


@cache
def digest() -> str:
    """Return a short digest of all static files."""
    total = hashlib.sha256()
    for path in sorted(static_folder().rglob("*")):
        if path.is_file():
            total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()[:12]


def url(name: str) -> str:
    """Return the address of a static file, which changes when any file changes."""
    return f"{STATIC}/{name}?v={digest()}"


@cache
def map_style_id() -> str:
    """Return the id of the style sheet of Plotly's maps.

    No page has a map of Plotly: an element of this id avoids 80 kB of inline style.
    """
    found = re.search(r'getElementById\("([0-9a-f]{64})"\)', plotly_script().read_text("utf-8"))
    return found[1] if found else "no-map-style"


def inline_styles() -> Markup:
    """Return all styles with the fonts, for a page in one file."""
    folder = static_folder()
    text = "".join((folder / name).read_text("utf-8") for name in ("tokens.css", "site.css"))
    return Markup(_FONT.sub(lambda found: _data_url(folder / found[1]), text))


def inline_script(name: str) -> Markup:
    """Return a script for a page in one file, with the modules that it imports."""
    folder = static_folder()
    text = (folder / name).read_text("utf-8")
    return Markup(_IMPORT.sub(lambda found: f'from "{_module_url(folder / found[1])}"', text))


def tokens(mode: str) -> dict[str, str]:
    """Return the colour of each token in light or dark."""
    text = (static_folder() / "tokens.css").read_text("utf-8")
    light, _, dark = text.partition(':root[data-theme="dark"]')
    found = dict(_TOKEN.findall(light))
    return found if mode == "light" else found | dict(_TOKEN.findall(dark))


def _module_url(path: Path) -> str:
    """Return a module without imports of its own as a data URL."""
    return f"data:text/javascript;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _data_url(path: Path) -> str:
    """Return a font as a data URL."""
    return f'url("data:font/woff2;base64,{base64.b64encode(path.read_bytes()).decode()}")'
