"""Pages: frozen values with what a page shows, and functions from them to HTML.

Rows are mappings named as the database names them. The templates escape every text.
"""

from spheremark.web.pages.base import ErrorPage, Frame, error_page
from spheremark.web.pages.jobs import (
    JobPage,
    JobsPage,
    RecordingPage,
    job_page,
    jobs_page,
    recording_page,
)
from spheremark.web.pages.sql import EXAMPLES, SqlPage, sql_page
from spheremark.web.pages.stop import StopPage, stop_page
from spheremark.web.pages.survey import (
    OverviewPage,
    SurveyData,
    SurveyPage,
    SurveyResults,
    overview_page,
    survey_page,
)

__all__ = [
    "EXAMPLES",
    "ErrorPage",
    "Frame",
    "JobPage",
    "JobsPage",
    "OverviewPage",
    "RecordingPage",
    "SqlPage",
    "StopPage",
    "SurveyData",
    "SurveyPage",
    "SurveyResults",
    "error_page",
    "job_page",
    "jobs_page",
    "overview_page",
    "recording_page",
    "sql_page",
    "stop_page",
    "survey_page",
]
