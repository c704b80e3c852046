"""The resection methods side by side, through the command line."""

import json
from contextlib import redirect_stdout
from io import StringIO

import pytest

from spheremark.service.cli.main import main

METHODS = ("free_station", "ranges", "paper")


def test_every_method_positions_the_station_and_says_how_well(stop):
    out, marks = StringIO(), stop.log.parent / "control.csv"
    chosen = [word for method in METHODS for word in ("--resection", method)]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        words = ["spheremark", "process", stop.log, "--control", marks, "--truth", stop.truth]
        patch.setattr("sys.argv", [*map(str, words), *chosen, "--json"])
        with pytest.raises(SystemExit) as ended:
            main()
    assert not ended.value.code
    (answer,) = json.loads(out.getvalue())["stops"]
    stations = {station["method"]: station for station in answer["stations"]}
    assert tuple(stations) == METHODS
    assert answer["station"]["method"] == "free_station"
    for station in stations.values():
        assert station["error_3d_m"] < 4 * station["sigma_3d_m"]
    assert stations["free_station"]["sigma_3d_m"] < stations["paper"]["sigma_3d_m"]
    assert len(stations["paper"]["matches"]) == 3
