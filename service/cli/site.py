"""``spheremark site``: the stops of a survey in one frame, as a cloud and as ground."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spheremark.service.cli.options import AsJson, Field, RadiusM, grouped
from spheremark.service.cli.reading import Logs, Reading
from spheremark.service.cli.terminal import err, out, print_json, progress


@grouped
def site(
    logs: Logs,
    reading: Reading,
    field: Field,
    laz: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write the cloud in the site frame (LAZ).")
    ] = None,
    e57: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write the cloud as scans with their poses (E57)."),
    ] = None,
    geotiff: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write the ground's heights and sigmas (GeoTIFF)."),
    ] = None,
    cell_m: Annotated[float, typer.Option(help="Edge of a cell of the ground \\[m].")] = 0.25,
    ground_range_m: Annotated[
        float, typer.Option(help="How far from a station ground is used \\[m].")
    ] = 15.0,
    gap_m: Annotated[
        float, typer.Option(help="Fill holes of the ground up to this \\[m]; 0: none.")
    ] = 0.0,
    range_m: Annotated[float, typer.Option(help="How far the cloud reaches \\[m].")] = 30.0,
    voxel_m: Annotated[
        float, typer.Option(help="Keep a return in cubes of this edge \\[m]; 0: all.")
    ] = 0.0,
    radius_m: RadiusM = 0.100,
    as_json: AsJson = False,
) -> None:
    """Put all stops into one frame: a cloud, and a model of the ground with its uncertainty."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.service.jobs import site as sites
    from spheremark.service.provenance import code_version

    given = {"laz": laz, "e57": e57, "geotiff": geotiff}
    targets = {kind: path for kind, path in given.items() if path is not None}
    if not targets:
        err.print("[bold red]Error:[/] name at least one of --laz, --e57 and --geotiff.")
        raise typer.Exit(2)
    options = {"cell_m": cell_m, "ground_range_m": ground_range_m, "gap_m": gap_m}
    request = sites.SiteRequest(
        targets=targets,
        elevation=sites.elevation_of(options),
        range_max=range_m,
        voxel=voxel_m,
        software=f"spheremark {code_version()}",
    )
    config = SurveyConfig.from_mapping(
        {"marker_radius": radius_m, "fitting": {"methods": ["along_beam"]}}
    )
    marks, rig = field.read()
    with progress() as track:
        made, network = sites.of_logs(reading.files(logs), marks, rig, config, request, track)
    plain = sites.serialise_site(made, request, network)
    if as_json:
        print_json(plain)
    else:
        _print(plain)


def _print(plain: dict[str, Any]) -> None:
    """Print the files that were written."""
    kind = "a free network" if plain["poses"] == "free" else "a network with control"
    out.print(f"{plain['n_stations']} stations, by {kind}.")
    for one in plain["refused"]:
        out.print(f"Without {one['station']}: {one['reason']}", markup=False, soft_wrap=True)
    for file in plain["files"]:
        text = f"{file['path']}: {file['n_points']:,} returns"
        if "cell_m" in file:
            text += (
                f" in cells of {file['cell_m']:g} m, {100 * file['share_known']:.0f} % of them "
                f"seen, median sigma {1000 * file['sigma_median_m']:.1f} mm"
            )
        out.print(text, soft_wrap=True, highlight=False)
