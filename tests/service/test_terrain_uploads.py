"""Foreign terrains over HTTP: each is read, or refused with a reason, and leaves nothing behind."""

import hashlib
import socket
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue import plans
from tests.storage import hostile_terrains as made

URL = "/api/v1/terrains"
REFERENCES = [name for name, _, _ in made.references("", "", "")]
OTHERS = {
    name: (ending, body)
    for source in (made.clouds, made.rasters, made.disguised)
    for name, ending, body in source()
}


class Uploads:
    """A service, a file that it must not show, and an address that it must not reach."""

    def __init__(self, client, data, folder):
        self.client, self.data, self.folder = client, data, folder
        self.secret = folder / "secret.txt"
        self.secret.write_text(made.SECRET)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)

    def send(self, body, name):
        """Upload, and check what must be true of every answer."""
        answer = self.client.post(URL, params={"name": name}, content=body)
        assert answer.status_code == 201 or 400 <= answer.status_code < 500, answer.text
        if answer.status_code != 201:
            problem = answer.json()
            assert answer.headers["content-type"] == "application/problem+json"
            assert problem["code"].startswith("input")
            assert problem["detail"].rstrip().endswith((".", ")"))
            assert len(problem["detail"]) < 2000
            assert str(self.data) not in answer.text
        return answer

    def check(self):
        """Check that files and rows agree, and that nothing was reached or made."""
        rows = plans.list_terrains(self.client.app.state.service.catalogue)
        files = {str(one) for one in (self.data / "terrains").rglob("*") if one.is_file()}
        assert files == {row["url"] for row in rows}
        assert list(self.folder.iterdir()) == [self.secret]
        assert self.secret.read_text() == made.SECRET
        with pytest.raises(BlockingIOError):
            self.listener.accept()
        return rows


@pytest.fixture(scope="module")
def uploads(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    app = create_app(Settings(data=data, scheduler=scheduler))
    with TestClient(app, base_url="http://127.0.0.1:8000") as client:
        found = Uploads(client, data, tmp_path_factory.mktemp("elsewhere"))
        yield found
        found.listener.close()


@pytest.mark.parametrize("name", REFERENCES)
def test_a_file_that_refers_elsewhere_is_refused_and_nothing_is_reached(uploads, name):
    address = f"http://127.0.0.1:{uploads.listener.getsockname()[1]}"
    cases = made.references(uploads.secret, address, uploads.folder)
    ending, body = {one: (ending, body) for one, ending, body in cases}[name]
    answer = uploads.send(body, f"x{ending}")
    assert 400 <= answer.status_code < 500
    assert made.SECRET not in answer.text
    uploads.check()


@pytest.mark.parametrize("name", OTHERS)
def test_a_file_that_is_made_to_harm_is_refused(uploads, name):
    ending, body = OTHERS[name]
    answer = uploads.send(body, f"x{ending}")
    assert 400 <= answer.status_code < 500, answer.text
    uploads.check()


@pytest.mark.parametrize("ending", [".laz", ".tif", ".ply", ".asc", ".parquet"])
def test_damaged_files_are_read_or_refused(uploads, ending):
    kinds = {".laz": "laz", ".tif": "big tif", ".ply": "ply", ".asc": "asc", ".parquet": "parquet"}
    body = made.valid()[kinds[ending]][1]
    bodies = list(made.mutants(body, 40 if ending == ".laz" else 10))
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda one: uploads.send(one, f"x{ending}"), bodies))
    rows = {row["terrain_id"] for row in uploads.check()}
    for one, answer in zip(bodies, answers, strict=True):
        assert (hashlib.sha256(one).hexdigest() in rows) == (answer.status_code == 201)


@pytest.mark.parametrize("kind", made.valid())
def test_a_terrain_becomes_a_grid_and_the_same_one_twice_is_one(uploads, kind):
    ending, body = made.valid()[kind]
    first = uploads.send(body, f"first{ending}").json()
    again = uploads.send(body, f"again{ending}").json()
    assert first == again
    assert first["name"] == f"first{ending}"
    (row,) = [row for row in uploads.check() if row["terrain_id"] in first["key"]]
    assert row["url"].endswith(".npz")
    assert row["size_bytes"] == len(body)
    site = uploads.client.get(f"/api/v1/plans/sites/{first['key']}").json()
    assert site["name"] == f"first{ending}"


def test_a_grid_that_is_damaged_on_disk_is_said_so(uploads):
    ending, body = made.valid()["asc"]
    key = uploads.send(body + b"\n  \n", f"cut{ending}").json()["key"]
    path = uploads.data / "terrains" / f"{key.removeprefix('terrain:')}.npz"
    whole = path.read_bytes()
    for left in (whole[:100], b""):
        path.write_bytes(left)
        answer = uploads.client.get(f"/api/v1/plans/sites/{key}")
        assert (answer.status_code, answer.json()["code"]) == (400, "input.unreadable")
    path.write_bytes(whole)
    assert uploads.client.get(f"/api/v1/plans/sites/{key}").status_code == 200


def test_a_terrain_on_which_nothing_can_stand_is_refused(uploads):
    cells = np.full((10, 10), -9999)
    cells[4, 4] = 1
    text = "\n".join(" ".join(map(str, row)) for row in cells)
    head = "ncols 10\nnrows 10\nxllcorner 0\nyllcorner 0\ncellsize 0.5\nNODATA_value -9999\n"
    answer = uploads.send((head + text).encode(), "lone.asc")
    assert answer.status_code == 400
    assert "no terrain to plan on" in answer.json()["detail"]
    uploads.check()


def test_more_uploads_than_can_wait_are_refused(uploads, monkeypatch):
    readers = uploads.client.app.state.service.readers
    monkeypatch.setattr(readers, "_n", 10)
    _, body = made.valid()["asc"]
    answer = uploads.client.post(URL, params={"name": "one.asc"}, content=body + b"\n   \n")
    assert (answer.status_code, answer.json()["code"]) == (429, "busy")
    uploads.check()


def test_a_grid_that_is_gone_is_said_so(uploads):
    ending, body = made.valid()["asc"]
    key = uploads.send(body + b"\n \n", f"gone{ending}").json()["key"]
    path = uploads.data / "terrains" / f"{key.removeprefix('terrain:')}.npz"
    path.rename(path.with_suffix(".away"))
    answer = uploads.client.get(f"/api/v1/plans/sites/{key}")
    path.with_suffix(".away").rename(path)
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")
    assert str(uploads.data) not in answer.text
