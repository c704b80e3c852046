"""``spheremark jobs``: the jobs of a running service, listed or followed to their end."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer

from spheremark.service.cli.terminal import err, out, print_json
from spheremark.service.cli.terminal import settings as read_settings

_ACTIVE = ("accepted", "running")
_POLL = 0.5  # [s] between two requests for the state of the jobs


def jobs(
    job: Annotated[str | None, typer.Argument(help="Id of one job, or its beginning.")] = None,
    url: Annotated[
        str | None, typer.Option("--url", "--server", help="Address of the service.")
    ] = None,
    survey: Annotated[str | None, typer.Option(help="Only the jobs of this survey.")] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Show progress until the jobs have ended.")
    ] = False,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="How many, newest first.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="JSON for programs.")] = False,
) -> None:
    """List the jobs of a running service, or follow them to their end; 1 where one failed."""
    from spheremark.service.client import Client

    settings = read_settings()
    address = url or settings.address()
    query = {"limit": limit if job is None else 1000} | ({"survey": survey} if survey else {})
    with Client(address, token=settings.token_text) as client:
        found: list[dict[str, Any]] = client.request("GET", "/jobs", params=query)["items"]
        chosen = _chosen(found, job)
        if follow:
            chosen = _followed(client, chosen)
    if as_json:
        print_json(chosen)
    else:
        _print(chosen)
    if follow and any(one["status"] != "successful" for one in chosen):
        raise typer.Exit(1)


def _chosen(found: list[dict[str, Any]], job: str | None) -> list[dict[str, Any]]:
    """Return the jobs whose id begins so; all without one."""
    from spheremark.pipelines.errors import NotFoundError

    chosen = [one for one in found if one["job_id"].startswith(job or "")]
    if job is not None and len(chosen) != 1:
        raise NotFoundError(
            f"{len(chosen)} of the newest {len(found)} jobs have an id that begins with {job!r}; "
            "one is expected. `spheremark jobs` lists them."
        )
    return chosen


def _followed(client: Any, chosen: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Show bars with the time left until all jobs have ended, and return them."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    open_jobs = [one for one in chosen if one["status"] in _ACTIVE] or chosen[:1]
    columns = (TextColumn("{task.fields[name]}"), BarColumn(20), TimeElapsedColumn(), TimeLeft())
    with Progress(*columns, console=err, disable=not err.is_terminal) as shown:
        bars = {one["job_id"]: shown.add_task("", total=100, name=_name(one)) for one in open_jobs}
        while True:
            states = [client.request("GET", f"/jobs/{one}") for one in bars]
            for one in states:
                shown.update(bars[one["job_id"]], completed=one["progress_percent"])
            if not any(one["status"] in _ACTIVE for one in states):
                return states
            time.sleep(_POLL)


def _name(job: dict[str, Any]) -> str:
    """Return what a job is about, in a few characters."""
    return f"{job['kind']} {job['recording'] or job['survey']}"[:28]


def _print(chosen: list[dict[str, Any]]) -> None:
    """Print one job with its result after the other, in two lines each."""
    for one in chosen:
        head = f"{one['job_id'][:8]}  {_name(one):<28}  {one['status']}"
        percent = f"  {one['progress_percent']:.0f} %" if one["status"] == "running" else ""
        waits = "".join(f" {each[:8]}" for each in one["waits_for"])
        out.print(head + percent, markup=False, highlight=False)
        text = one["error_reason"] or one["message"]
        text += f" Waits for{waits}." if waits else ""
        out.print(f"          {text}", markup=False, highlight=False)
    if not chosen:
        err.print("No jobs.")
