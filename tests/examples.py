"""Write the examples of the interface's description, from a service with a surveyed lane.

usage: python -m tests.examples ADDRESS  (of a service that `spheremark demo` began, with a network,
a calibration and a site)
"""

import json
import secrets
import sys
from pathlib import Path

import httpx

TARGET = Path(__file__).parents[1] / "service/http/api/examples.json"
SURVEY = "paper-field"
SQL = "SELECT stop, sigma_3d_m FROM latest_station_fixes WHERE fit_method = 'along_beam' LIMIT 3"
PLAN = {
    "site": "paper-field",
    "marks": [
        {"name": "A", "x_m": 8.0, "y_m": 0.0, "pole_height_m": 1.2},
        {"name": "B", "x_m": -4.0, "y_m": 7.0, "pole_height_m": 0.8},
        {"name": "C", "x_m": -4.0, "y_m": -7.0, "pole_height_m": 1.5},
    ],
    "stops": [{"name": "S1", "x_m": 0.0, "y_m": 0.0}],
}
RULES = {"reach_m": 6.0, "apart_m": 1.0}
RANDOM = {"n_arrangements": 2000, "seed": 1}
NUMBERS = 6  # of a list of numbers that an example keeps


class Examples:
    """Requests to a service, kept as examples of its operations."""

    def __init__(self, client):
        self.client, self.found = client, {}

    def get(self, name, path, shown=True, **parameters):
        """Keep a GET and return its response."""
        response = self.client.get(path, params=parameters)
        response.raise_for_status()
        return self._keep(name, response, None, parameters, shown)

    def send(self, name, method, path, body, shown=True, **parameters):
        """Keep a request with a body and return its response."""
        response = self.client.request(method, path, json=body, params=parameters)
        response.raise_for_status()
        return self._keep(name, response, body, parameters, shown)

    def _keep(self, name, response, body, parameters, shown):
        """Keep what was sent and what came back."""
        example = {"parameters": parameters} if parameters else {}
        if body is not None:
            example["body"] = body
        found = response.json() if "json" in response.headers["content-type"] else None
        if shown and found is not None:
            example |= {"status": str(response.status_code), "response": shortened(found)}
        self.found[name] = example
        return found


def shortened(value):
    """Return a value with the first items of its long lists."""
    if isinstance(value, dict):
        return {key: shortened(one) for key, one in value.items()}
    if not isinstance(value, list):
        return value
    is_table = any(isinstance(one, dict) for one in value)
    return [shortened(one) for one in value[: 1 if is_table else NUMBERS]]


def read(examples):
    """Keep what can be read of a service that has results."""
    get = examples.get
    get("list_surveys", "/surveys")
    get("get_survey", f"/surveys/{SURVEY}")
    get("get_control", f"/surveys/{SURVEY}/control")
    recording = get("list_recordings", "/recordings", limit=1)["items"][0]["recording_id"]
    get("get_recording", f"/recordings/{recording}")
    get("get_preflight", f"/recordings/{recording}/preflight")
    job = get("list_jobs", "/jobs", survey=SURVEY, status="successful", limit=1)["items"][0]
    get("get_job", f"/jobs/{job['job_id']}")
    run = get("list_runs", "/runs", survey=SURVEY, limit=1)["items"][0]["run_id"]
    get("get_run", f"/runs/{run}")
    chosen = {"survey": SURVEY, "fit_method": "along_beam", "status": "ok", "limit": 1}
    for name, path in (("marker_fit", "/marker-fits"), ("station_fix", "/station-fixes")):
        row = get(f"list_{name}{'es' if name == 'station_fix' else 's'}", path, **chosen)
        get(f"get_{name}", f"{path}/{row['items'][0]['id']}")
    for name in ("adjustment", "calibration"):
        rows = get(f"list_{name}s", f"/{name}s", survey=SURVEY, limit=1)["items"]
        if rows:  # no calibration is possible where no sphere is seen on both faces
            get(f"get_{name}", f"/{name}s/{rows[0][f'{name}_id']}")
    get("list_products", f"/surveys/{SURVEY}/products")
    get("get_schema", "/sql/schema")
    get("query_by_link", "/sql", q=SQL)
    get("export_coordinates", "/export/coordinates.csv", survey=SURVEY)
    get("export_points", "/export/coordinates.geojson", False, survey=SURVEY, origin="-15.5,8.3,30")
    get("list_audit", "/audit", limit=1)
    get("list_problems", "/problems")
    get("get_problem", "/problems/not_found")
    get("get_config", "/config")
    get("list_sites", "/plans/sites")
    get("get_site", "/plans/sites/paper-field")


def write(examples):
    """Keep what changes a service, and what it computes."""
    send = examples.send
    survey = send(
        "create_survey",
        "POST",
        "/surveys",
        {"name": f"quarry {secrets.token_hex(2)}", "tolerance_m": 0.02},
    )
    own = f"/surveys/{survey['survey_id']}"
    marks = {"marks": [{"mark": "M01", "x_m": 7.1, "y_m": 0.4, "z_m": 1.2, "sigma_z_m": 0.001}]}
    send("put_control", "PUT", f"{own}/control", marks)
    send("choose_rig", "PUT", f"{own}/rig", {"rig_digest": None})
    marks = [{"name": "M01", "position_m": [7.1, 0.4, 1.2]}]
    truth = {"format": "spheremark-truth/1", "marks": marks, "stops": []}
    send("put_truth", "PUT", f"{own}/truth", truth)
    send("query", "POST", "/sql", {"sql": SQL})
    send("evaluate_plan", "POST", "/plans/evaluate", PLAN)
    send("optimise_plan", "POST", "/plans/optimise", PLAN | {"n_marks": 3, "rules": RULES})
    send("suggest_mark", "POST", "/plans/suggest", PLAN | {"rules": RULES})
    send("try_at_random", "POST", "/plans/random", RANDOM)
    plan = send("keep_plan", "POST", "/plans", PLAN | {"name": "three marks", "survey": SURVEY})
    examples.get("list_plans", "/plans", survey=SURVEY)
    examples.get("get_plan", f"/plans/{plan['placement_id']}")
    run = examples.client.get("/runs", params={"survey": SURVEY, "limit": 1}).json()["items"][0]
    rig = examples.get("get_rig", f"/rigs/{run['rig_digest']}")["rig"]
    send("put_rig", "POST", "/rigs", rig)
    job = send("create_job", "POST", "/jobs", {"kind": "adjust", "survey": SURVEY})
    examples.send("dismiss_job", "DELETE", f"/jobs/{job['job_id']}", None)


def described(examples):
    """Keep parameters of what takes or returns files."""
    examples.found |= {
        "upload_recording": {
            "parameters": {"name": "lane3-stop1", "survey": SURVEY, "process": True}
        },
        "get_octree_node": {"parameters": {"node": "r0"}},
        "upload_terrain": {"parameters": {"name": "quarry.tif"}},
        "download_adjustment": {"parameters": {"name": "report.txt"}},
        "download_calibration": {"parameters": {"name": "rig.json"}},
        "export_points": examples.found["export_points"]
        | {"parameters": {"kind": "geojson", "survey": SURVEY, "origin": "-15.5,8.3,30"}},
    }


def main():
    """Write the file."""
    with httpx.Client(base_url=f"{sys.argv[1]}/api/v1", timeout=300) as client:
        examples = Examples(client)
        read(examples)
        write(examples)
    described(examples)
    TARGET.write_text(json.dumps(examples.found, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
