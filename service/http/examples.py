"""Examples of the operations of the interface, as a service with the demonstration gave them."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

from spheremark.service.http.errors import MEDIA_TYPE

Plain = dict[str, Any]

_PROBLEM: Plain = {
    "type": "/api/v1/problems/not_found",
    "title": "There is no such thing.",
    "status": 404,
    "detail": "There is no survey 'quarry'.",
    "instance": "/api/v1/surveys/quarry",
    "code": "not_found",
}

_BINARY = "(the bytes of the file)"
_TEXTS = {
    "text/csv": "mark,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m\nM01,7.1,0.4,1.2,0,0,0.001\n",
    "text/event-stream": 'id: 3\nevent: progress\ndata: {"progress_percent": 40}\n\n',
    "application/geo+json": '{"type": "FeatureCollection", "features": []}',
    "application/xml": '<?xml version="1.0"?><LandXML version="1.2"></LandXML>',
    "image/vnd.dxf": "  0\nSECTION\n",
}
_DIGEST = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
_PARAMETERS: Plain = {
    "survey": "paper-field",
    "recording": _DIGEST,
    "job": "5f0c2a17b3d94e60",
    "run": "0ef6a1c25b7d4983",
    "row": "0ef6a1c25b7d4983~lane3-stop1~along_beam~free_station",
    "adjustment": "77aa0c9d1be24f53",
    "calibration": "77aa0c9d1be24f53",
    "product": "c41f7be02a9d5836",
    "rig": "2f6d1be07c9a4e35",
    "plan": "a35c9e207d4f1b68",
    "site": "paper-field",
    "upload": "0b7c52e94f1d8a36",
    "code": "not_found",
    "name": "report.txt",
    "kind": "laz",
    "Tus-Resumable": "1.0.0",
    "Upload-Length": 1048576,
    "Upload-Offset": 0,
}
"""Values of parameters by name, where an operation has none of its own."""


def add_to(operation: Plain) -> None:
    """Add the examples of an operation to its description in OpenAPI."""
    found = _examples().get(operation["operationId"], {})
    given = _PARAMETERS | found.get("parameters", {})
    for parameter in operation.get("parameters", ()):
        if parameter["name"] in given:
            parameter["example"] = given[parameter["name"]]
    for media_type, body in operation.get("requestBody", {}).get("content", {}).items():
        if media_type != "application/json":
            body["example"] = _TEXTS.get(media_type, _BINARY)
        elif "body" in found:
            body["example"] = found["body"]
    for status, response in operation["responses"].items():
        _add_to_response(response, found.get("response") if found.get("status") == status else None)


def _add_to_response(response: Plain, shown: Any) -> None:
    """Add examples to a response: what was shown as JSON, and texts of the other types."""
    for media_type, content in response.get("content", {}).items():
        if media_type == MEDIA_TYPE:
            content["example"] = _PROBLEM
        elif media_type != "application/json":
            content["example"] = _TEXTS.get(media_type, _BINARY)
        elif shown is not None:
            content["example"] = shown


@cache
def _examples() -> Plain:
    """Return the examples by the id of their operation."""
    text = (
        resources.files("spheremark.service.http.api").joinpath("examples.json").read_text("utf-8")
    )
    found: Plain = json.loads(text)
    return found
