"""Routes of pages: queries of the catalogue, handed to the functions that draw."""

from spheremark.service.http.pages import (
    accuracy,
    clouds,
    compare,
    frame,
    jobs,
    logs,
    networks,
    overview,
    plans,
    reports,
    result,
    sites,
    stops,
)

ROUTERS = tuple(
    page.router
    for page in (
        *(frame, overview, compare, jobs, plans),
        *(sites, clouds, stops, networks, accuracy, logs, reports),
        result,  # last: the name of a survey takes slashes
    )
)
