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
    "node": "r07",
    "kind": "laz",
    "Tus-Resumable": "1.0.0",
    "Upload-Length": 1048576,
    "Upload-Offset": 0,
}
"""Values of parameters by name, where an operation has none of its own."""


def add_to(operation: Plain, schemas: Plain) -> None:
    """Add the examples of an operation to its description in OpenAPI."""
    found = _examples().get(operation["operationId"], {})
    given = _PARAMETERS | found.get("parameters", {})
    for parameter in operation.get("parameters", ()):
        if parameter["name"] in given:
            is_list = parameter["schema"].get("type") == "array"
            value = given[parameter["name"]]
            parameter["example"] = [value] if is_list else value
        elif parameter.get("required"):
            parameter["example"] = _sample(parameter["schema"], schemas)
    bodies = [(operation.get("requestBody", {}), found.get("body"))]
    bodies += [
        (response, found.get("response") if found.get("status") == status else None)
        for status, response in operation["responses"].items()
    ]
    for body, shown in bodies:
        for media_type, content in body.get("content", {}).items():
            content["example"] = _example(media_type, content.get("schema", {}), schemas, shown)


def _example(media_type: str, schema: Plain, schemas: Plain, shown: Any) -> Any:
    """Return the example of a body: what a service gave, else the least that its schema allows."""
    if media_type == MEDIA_TYPE:
        return _PROBLEM
    if media_type != "application/json":
        return _TEXTS.get(media_type, _BINARY)
    return _sample(schema, schemas) if shown is None else _completed(shown, schema, schemas)


def _completed(value: Any, schema: Plain, schemas: Plain) -> Any:
    """Return a value with the fields that its schema requires since it was taken."""
    if "$ref" in schema:
        return _completed(value, schemas[schema["$ref"].rpartition("/")[2]], schemas)
    if isinstance(value, list):
        return [_completed(one, schema.get("items", {}), schemas) for one in value]
    if not isinstance(value, dict) or "properties" not in schema:
        return value
    fields = schema["properties"]
    known = {key: _completed(one, fields.get(key, {}), schemas) for key, one in value.items()}
    missing = (name for name in schema.get("required", ()) if name not in known)
    return known | {name: _sample(fields[name], schemas) for name in missing}


def _sample(schema: Plain, schemas: Plain) -> Any:
    """Return a value that a schema allows, with the fields that it requires."""
    if "$ref" in schema:
        return _sample(schemas[schema["$ref"].rpartition("/")[2]], schemas)
    for key in ("example", "default", "const"):
        if key in schema:
            return schema[key]
    if "enum" in schema:
        return schema["enum"][0]
    if "anyOf" in schema:
        return _sample(schema["anyOf"][0], schemas)
    if schema.get("type") == "object":
        fields = schema.get("properties", {})
        return {name: _sample(fields[name], schemas) for name in schema.get("required", ())}
    return _simple(schema, schemas)


def _simple(schema: Plain, schemas: Plain) -> Any:
    """Return a list, a text or a number that a schema allows."""
    kind: str = schema.get("type", "string")
    least: float = schema.get("minimum", 0)
    if kind == "array":
        items = schema.get("prefixItems") or [schema["items"]] * schema.get("minItems", 0)
        return [_sample(one, schemas) for one in items]
    if schema.get("format") == "date-time":
        return "2026-11-22T12:00:00Z"
    above: float = schema.get("exclusiveMinimum", least)
    values = {"integer": least, "number": above + 1.0}
    return values.get(kind, kind == "boolean" or "name")


@cache
def _examples() -> Plain:
    """Return the examples by the id of their operation."""
    text = (
        resources.files("spheremark.service.http.api").joinpath("examples.json").read_text("utf-8")
    )
    found: Plain = json.loads(text)
    return found
