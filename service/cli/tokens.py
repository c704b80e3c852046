"""``spheremark token``: tokens of a data folder are made, listed and revoked."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from spheremark.service.cli.terminal import err, out, print_json
from spheremark.service.tokens import Scope, Tokens

token = typer.Typer(help="Make, list and revoke the tokens of a service.", no_args_is_help=True)

Data = Annotated[Path | None, typer.Option(file_okay=False, help="Data folder of the service.")]
Name = Annotated[str, typer.Argument(help="Name of the token, of who or what uses it.")]


@token.command()
def create(
    name: Name,
    scope: Annotated[
        Scope, typer.Option(help="Read; write: upload, plan and start jobs; admin: audit log too.")
    ] = Scope.WRITE,
    data: Data = None,
) -> None:
    """Make a token and print it, once: only its digest is kept."""
    text = _tokens(data).make(name, scope)
    sys.stdout.write(text + "\n")
    err.print(f"The token {name} allows to {scope}. It is shown only now.", highlight=False)


@token.command("list")
def list_tokens(
    data: Data = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON for programs.")] = False,
) -> None:
    """List the tokens, without their secrets."""
    found = [
        {"name": one.name, "scope": one.scope.value, "created_at": one.created_at}
        for one in _tokens(data).all()
    ]
    if as_json:
        print_json(found)
        return
    for one in found:
        out.print(f"{one['name']}  {one['scope']}  {one['created_at']}", markup=False)


@token.command()
def revoke(name: Name, data: Data = None) -> None:
    """Revoke a token; a service that runs refuses it at once."""
    _tokens(data).revoke(name)
    err.print(f"The token {name} is revoked.", highlight=False)


def _tokens(data: Path | None) -> Tokens:
    """Return the tokens of a data folder, by default the one of the settings."""
    from spheremark.service.cli.terminal import settings

    return Tokens((data or settings(host="127.0.0.1").data).resolve())
