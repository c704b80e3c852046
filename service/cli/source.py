"""Where the command line finds results: a running service, or a data folder that none uses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from shutil import copyfile
from typing import Any
from urllib.parse import quote

import httpx

from spheremark.pipelines.errors import ConflictError, InputError
from spheremark.service.client import Client
from spheremark.service.serialise.queries import serialise_query
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.coordinates import coordinates_csv, named_points
from spheremark.storage.catalogue.sandbox import run_query
from spheremark.storage.exports.points import GeographicOrigin, format_points

_EXPORTS = (".duckdb", ".csv", ".dxf", ".xml", ".geojson")


class Source:
    """Results, wherever they are: at an address, in a folder, or at what the settings name."""

    def __init__(self, settings: Settings, url: str | None, *, folder: Path | None) -> None:
        if url and folder:
            raise InputError("Give either --url or --data: results come from one place.")
        self._settings = settings
        self._url = url or ("" if folder else self._running())

    def query(self, sql: str) -> dict[str, Any]:
        """Run one SELECT."""
        if self._url:
            with self._client() as client:
                return client.request("POST", "/sql", json={"sql": sql})
        with self._catalogue() as catalogue:
            snapshot, limits = catalogue.snapshot(), self._settings.query_limits
            return serialise_query(run_query(snapshot, sql, limits), limits, snapshot)

    def export(self, target: Path, survey: str | None, origin: str | None) -> None:
        """Write the database, a table of coordinates or points to a file, by its ending."""
        if target.suffix not in _EXPORTS:
            raise InputError(f"{target.name} must end in one of {', '.join(_EXPORTS)}.")
        given = {"survey": survey, "origin": origin} if target.suffix != ".duckdb" else {}
        query = {name: value for name, value in given.items() if value}
        if self._url:
            name = "results" if target.suffix == ".duckdb" else "coordinates"
            with self._client() as client:
                client.download(f"/export/{name}{target.suffix}", target, **query)
            return
        with self._catalogue() as catalogue:
            if target.suffix == ".duckdb":
                with catalogue.lent_export() as copy:
                    copyfile(copy, target)
            elif target.suffix == ".csv":
                target.write_bytes(coordinates_csv(catalogue, survey))
            else:
                place = GeographicOrigin.parse(origin) if origin else None
                points = named_points(catalogue, survey)
                target.write_text(format_points(points, target.suffix, place), encoding="utf-8")

    def report(self, survey: str, target: Path, adjustment: str | None) -> None:
        """Write the report of a survey to a file, as PDF or HTML by its ending."""
        if self._url:
            query = {"adjustment": adjustment} if adjustment else {}
            with self._client() as client:
                path = f"/surveys/{quote(survey, safe='')}/report{target.suffix}"
                client.download(path, target, **query)
            return
        from spheremark.service.serialise.survey_report import survey_report
        from spheremark.web.pages.report import report_html, report_pdf

        with self._catalogue() as catalogue:
            made = survey_report(catalogue, survey, adjustment)
        is_pdf = target.suffix == ".pdf"
        target.write_bytes(report_pdf(made) if is_pdf else report_html(made).encode())

    def _running(self) -> str:
        """Return the address of the settings if a service answers there."""
        address = self._settings.address()
        try:
            httpx.get(f"{address}/healthz", timeout=2.0)
        except httpx.HTTPError:
            return ""
        return address

    def _client(self) -> Client:
        """Return a connection to the service."""
        return Client(self._url, token=self._settings.token_text, timeout=120.0)

    @contextmanager
    def _catalogue(self) -> Iterator[Catalogue]:
        """Open the database of the data folder, which no other process may have open."""
        path = self._settings.database
        if not path.exists():
            raise InputError(
                f"No service answers at {self._settings.address()}, and the folder "
                f"{self._settings.data.resolve()} has no database. Start `spheremark serve`, name "
                "the address of a service with --url, or a data folder with --data."
            )
        try:
            opened = Catalogue(path, snapshots=self._settings.snapshots)
        except ConflictError as error:
            address = self._running()
            where = f"--server {address}" if address else "--server and its address"
            raise ConflictError(
                f"{error} Or take the results from that service: {where} in place of --data."
            ) from error
        with closing(opened) as catalogue:
            yield catalogue
