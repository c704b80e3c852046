"""The Python examples of the README run as they stand there."""

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = re.findall(
    r"```python\n(.*?)```", (Path(__file__).parents[1] / "README.md").read_text(), re.S
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that the examples name."""
    made = tmp_path_factory.mktemp("notebook")
    command = [sys.executable, "-m", "spheremark.service.cli", "simulate", made / "logs"]
    subprocess.run([*command, "--stops", "lane1-stop1"], check=True, capture_output=True)
    shutil.copy(made / "logs" / "control.csv", made / "marks.csv")
    shutil.copy(made / "logs" / "lane1-stop1.mcap", made / "stop1.mcap")
    return made


@pytest.fixture
def address(folder):
    """The address of a service that runs."""
    command = [sys.executable, "-m", "spheremark.service.cli", "serve", "--port", "0"]
    with subprocess.Popen(
        [*command, "--data", folder / "data"], stderr=subprocess.PIPE, text=True
    ) as served:
        for line in served.stderr:
            if found := re.search(r"http://\S+", line):
                break
        yield found.group()
        served.send_signal(signal.SIGTERM)


def test_there_is_an_example_in_memory_and_one_of_a_service():
    assert ["Client" in one for one in EXAMPLES] == [False, True]


def test_the_example_in_memory_gives_centres(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    exec(EXAMPLES[0], names)
    assert len(names["centres"]) >= 10
    assert names["centres"].rms_m.between(0.001, 0.05).all()


@pytest.mark.slow
def test_the_example_of_a_service_gives_stations(folder, address, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    exec(EXAMPLES[1].replace("http://127.0.0.1:8000", address), names)
    names["client"].close()
    assert set(names["stations"].survey) == {"quarry"}
    assert (names["stations"].sigma_3d_m < 0.03).any()
