"""The pages of jobs and of recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spheremark.web.pages.base import Frame, Row
from spheremark.web.templating import render


@dataclass(frozen=True, slots=True, kw_only=True)
class JobsPage:
    """The newest jobs."""

    frame: Frame
    jobs: tuple[Row, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPage:
    """One job with its stops, and its results on the whole survey."""

    frame: Frame
    job: Row
    stops: tuple[Row, ...]
    made: tuple[Row, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingPage:
    """One recording: its preflight report and its jobs."""

    frame: Frame
    recording: Row
    preflight: Mapping[str, Any]
    jobs: tuple[Row, ...]
    address: str


def jobs_page(page: JobsPage) -> str:
    """Return the list of jobs."""
    return render("jobs.html", page, here="jobs")


def job_page(page: JobPage) -> str:
    """Return one job with its progress."""
    config = json.dumps(json.loads(page.job["config"]), indent=2)
    options = json.loads(page.job["options"] or "{}")
    return render("job.html", page, here="jobs", config=config, options=options)


def recording_page(page: RecordingPage) -> str:
    """Return one recording with its preflight report."""
    return render("recording.html", page, here="overview")
