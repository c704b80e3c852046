"""``spheremark spheres``: the spheres in the cloud of any single scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spheremark.service.cli.terminal import out, print_json


def spheres(
    file: Annotated[
        Path,
        typer.Argument(
            exists=True,
            dir_okay=False,
            help="Cloud of one scan: LAS, LAZ, PLY, PCD, E57, NPY, or text with x y z, in metres.",
        ),
    ],
    radius_m: Annotated[
        float, typer.Option("--radius-m", "--radius", help="Radius of the spheres \\[m].")
    ],
    station: Annotated[
        str, typer.Option(help="Position of the scanner in the cloud's frame: x,y,z \\[m].")
    ] = "0,0,0",
    divergence_mrad: Annotated[
        float, typer.Option(min=0.0, help="Full width of the beam \\[mrad]; 0.1 to 0.3 for a TLS.")
    ] = 3.0,
    scan: Annotated[int, typer.Option(min=0, help="Which scan of an E57 file.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="JSON for programs.")] = False,
) -> None:
    """Find and fit spheres of known radius in the cloud of one scan, without a log."""
    from spheremark.pipelines.interface import find_spheres
    from spheremark.service.cli import render
    from spheremark.service.serialise.stops import serialise_spheres
    from spheremark.storage.imports.scans import read_scan

    origin = _position(station)
    points = read_scan(file, number=scan)
    fits = find_spheres(points, radius_m, origins=origin, divergence=divergence_mrad / 1000.0)
    plain: dict[str, Any] = {
        "file": file.name,
        "radius_m": radius_m,
        "station_m": list(origin),
        "n_points": len(points),
        **serialise_spheres(fits),
    }
    if as_json:
        print_json(plain)
    else:
        render.print_spheres(out, plain)
    if not fits.fits:
        raise typer.Exit(1)


def _position(text: str) -> tuple[float, ...]:
    """Return three coordinates."""
    from spheremark.pipelines.errors import ConfigError

    try:
        position = tuple(float(one) for one in text.split(","))
    except ValueError:
        position = ()
    if len(position) != 3:
        raise ConfigError(f"--station is {text!r}; three numbers are expected, as in 1.5,0,2.")
    return position
