"""The dashboard of accuracy, of one survey or of many: figures and tables that load by address."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from urllib.parse import urlencode

from spheremark.web.pages.base import Frame, Place
from spheremark.web.templating import render

Column = tuple[str, str, str]

CENTRES: tuple[Column, ...] = (
    ("stop", "Stop", "link"),
    ("survey", "Survey", "text"),
    ("fit_method", "Method", "method"),
    ("marker", "Marker", "text"),
    ("mark", "Mark", "text"),
    ("status", "Status", "status"),
    ("range_m", "Distance [m]", "m"),
    ("n_points", "Returns", "count"),
    ("incidence_deg", "Incidence [deg]", "deg"),
    ("sigma_3d_m", "Sigma [mm]", "mm"),
    ("error_3d_m", "Error [mm]", "mm"),
    ("error_radial_m", "Radial [mm]", "mm"),
)
"""Columns of tables: name in the database, heading, and how its values are written."""

_FILTERS = (
    ("range_from_m", "range_to_m", "Distance [m]"),
    ("count_from", "count_to", "Returns"),
    ("incidence_from_deg", "incidence_to_deg", "Incidence [deg]"),
)
_PLACES = ("distance", "count", "incidence", "angle", "distribution", "map", "surveys")


def accuracy_page(
    frame: Frame,
    query: Mapping[str, Sequence[str]],
    *,
    survey: str,
    methods: Sequence[str],
    has_truth: bool,
) -> str:
    """Return the dashboard of the selection in a query; without a survey over all of them.

    The page holds no result: its size does not depend on the surveys.
    """
    chosen = [(name, value) for name, values in query.items() for value in values if value]
    chosen = [(name, value) for name, value in chosen if name not in ("sort", "after")]
    if survey:
        chosen = [
            ("survey", survey),
            *((name, value) for name, value in chosen if name != "survey"),
        ]
    rows = [(name, value) for name, value in chosen if name != "axes"]
    names = [name for name in _PLACES if name != "surveys" or not survey]
    names = [name for name in names if name != "map" or survey]
    errors = ("error_3d_m", "error_radial_m", "error_rms_m", "error_max_m", "station_error_3d_m")

    def columns(known: Sequence[Column]) -> str:
        left = [one for one in known if not survey or one[0] != "survey"]
        return json.dumps([one for one in left if has_truth or one[0] not in errors])

    quality = "error_3d_m" if has_truth else "sigma_3d_m"
    return render(
        "accuracy.html",
        frame=frame,
        survey=survey,
        has_truth=has_truth,
        places=[Place(name, _address(f"figures/{name}.json", chosen)) for name in names],
        limits=_address("accuracy/limits", rows),
        centres=_address("tables/centres.json", rows),
        centre_columns=columns(CENTRES),
        sort=f"-{quality}",
        methods=methods,
        filters=_FILTERS,
        first={name: values[-1] for name, values in query.items() if values},
        chosen_methods=query.get("method", ()),
        chosen_surveys=query.get("survey", ()),
        is_filtered=bool([name for name, _ in chosen if name not in ("survey", "axes")]),
    )


def _address(path: str, query: Sequence[tuple[str, str]]) -> str:
    """Return an address of the interface for programs."""
    return f"/api/v1/{path}" + (f"?{urlencode(query)}" if query else "")
