"""The reference page of commands and settings, made from the commands and the settings themselves.

``python -m spheremark.service.cli.reference`` prints it; ``make reference`` keeps it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from enum import Enum
from typing import Any

import typer

from spheremark.pipelines.simulation.worlds import FAMILIES, PRIORS
from spheremark.service.cli.main import app
from spheremark.service.settings import Settings

_HEAD = """# Reference
Commands and settings, made by `make reference` from what `--help` prints and from the settings of
the service. Exit codes: 0 done, 1 failed, 2 misused. `--json` is for programs; progress goes to
standard error.
"""


def reference() -> str:
    """Return the reference page as Markdown."""
    parts = ["## Commands", *_commands(), "## Settings", *_settings()]
    return "\n".join([_HEAD, *parts, "", "## Random worlds", *_priors()]) + "\n"


def _commands() -> Iterator[str]:
    """Yield the lines of all commands, those of groups included."""
    yield ""
    for path, command in _walk("spheremark", typer.main.get_command(app)):
        yield f"### `{path}`\n{_sentence(command.help)}\n"
        rows = [row for parameter in command.params if (row := _row(parameter))]
        if rows:
            yield "| option | meaning | default |\n|---|---|---|"
            yield from rows
            yield ""


def _walk(path: str, command: Any) -> Iterator[tuple[str, Any]]:
    """Yield each command below a group with the words that call it."""
    children = getattr(command, "commands", None)
    if children is None:
        yield path, command
        return
    for name, child in children.items():
        yield from _walk(f"{path} {name}", child)


def _row(parameter: Any) -> str:
    """Return the row of an argument or an option; empty for ``--help``."""
    if parameter.name == "help":
        return ""
    names = "/".join((*parameter.opts, *parameter.secondary_opts))
    if not parameter.opts[0].startswith("-"):
        names = parameter.metavar or parameter.name.upper()
    text = _sentence(parameter.help)
    if isinstance(parameter.default, Enum):
        values = ", ".join(f"`{one.value}`" for one in type(parameter.default))
        text = f"{text} One of {values}."
    return f"| `{names}` | {_cell(text)} | {_cell(_default(parameter))} |"


def _default(parameter: Any) -> str:
    """Return the default of a parameter as it would be typed."""
    value = parameter.default
    if parameter.required:
        return "required"
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    if value is None or value in ((), [], ""):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        return " ".join(str(getattr(one, "value", one)) for one in value)
    return str(getattr(value, "value", value))


def _settings() -> Iterator[str]:
    """Yield the table of settings."""
    yield "\nAll from the environment, for `demo` and `serve` alike.\n"
    yield "| variable | meaning | default |\n|---|---|---|"
    for name, field in Settings.model_fields.items():
        default = "" if field.default_factory or field.default is None else str(field.default)
        yield f"| `SPHEREMARK_{name.upper()}` | {_cell(field.description or '')} | {default} |"


def _priors() -> Iterator[str]:
    """Yield the table of priors of random worlds."""
    yield (
        "\n`simulate --world random` and `bench --worlds` draw these evenly between the bounds, or "
        "evenly in the logarithm (log).\nFamilies, in turn with every other seed: "
        f"{', '.join(FAMILIES)}.\n"
        "Besides: an even, Gaussian or two-lobed footprint; the strongest, first or last echo; "
        "with or without the cosine of\nincidence; constant noise or noise by reflectivity; no "
        "divergence in 15 % of the worlds where optics are wide.\nMarkers and decoys are on poles, "
        "one in ten on the ground, and three in ten of the others on a\ncrate, a drum, a rock, a "
        "table or a tripod.\n"
    )
    yield "| quantity | meaning | usual | wide | wide in |\n|---|---|---|---|---|"
    for name, prior in PRIORS.items():
        usual, wide = (f"{low:g} to {high:g}" for low, high in (prior.usual, prior.wide))
        how = f"{_cell(prior.what)}{', log' if prior.is_log else ''}"
        yield f"| {name} | {how} | {usual} | {wide} | {', '.join(prior.families)} |"


def _sentence(text: str | None) -> str:
    """Return a help text as one line."""
    return " ".join((text or "").split()).replace("\\[", "[")


def _cell(text: str) -> str:
    """Return a text that cannot break a table."""
    return text.replace("|", "\\|").strip()


if __name__ == "__main__":
    sys.stdout.write(reference())
