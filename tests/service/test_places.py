"""Requests that take long: few at a time, ended when their client leaves, health beside them."""

import asyncio
import contextlib
import json
import socket
import threading
import time

import psutil
import pytest
import uvicorn
from fastapi.testclient import TestClient

from spheremark.pipelines.progress import checked_by, checkpoint
from spheremark.service.errors import BusyError
from spheremark.service.http.app import create_app
from spheremark.service.http.places import Places
from spheremark.service.settings import Settings

SLOW = "SELECT sum(hash(i)) FROM range(1000000000000) AS t(i)"  # takes time, no memory
MANY = [{"name": f"m{i}", "x_m": i % 20 - 10.0, "y_m": i // 20 - 10.0, "pole_height_m": 1.0}
        for i in range(400)]  # fmt: skip


class Present:
    """A request whose client stays."""

    async def is_disconnected(self):
        return False


class Leaving(Present):
    """A request whose client leaves at once."""

    async def is_disconnected(self):
        return True


def test_beyond_those_that_run_and_wait_a_request_is_refused():
    async def crowd():
        places, release = Places("things", 1, 2), threading.Event()
        running = [asyncio.create_task(places.run(Present(), release.wait, 30)) for _ in range(3)]
        await asyncio.sleep(0.05)
        with pytest.raises(BusyError, match="3 things run or wait; 3 are the most"):
            await places.run(Present(), print)
        release.set()
        assert await asyncio.gather(*running) == [True] * 3
        assert await places.run(Present(), lambda: 7) == 7
        places.close()

    asyncio.run(crowd())


def test_what_no_client_waits_for_ends_at_the_next_checkpoint():
    reached = []

    def work():
        for i in range(10_000):
            checkpoint()
            reached.append(i)
            time.sleep(0.01)

    async def leave():
        places = Places("things", 1, 0)
        with pytest.raises(Exception, match="has left"):
            await places.run(Leaving(), work)
        places.close()

    asyncio.run(leave())
    assert len(reached) < 1000


def test_a_checkpoint_without_a_caller_that_checks_does_nothing():
    checkpoint()
    with checked_by(lambda: None):
        checkpoint()


@pytest.fixture(scope="module")
def server(tmp_path_factory, scheduler):
    app = create_app(
        Settings(data=tmp_path_factory.mktemp("data"), scheduler=scheduler, sql_seconds=60)
    )
    protocol = "spheremark.service.http.protocol:BoundedProtocol"
    server = uvicorn.Server(uvicorn.Config(app, port=0, http=protocol, log_level="critical"))
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()), daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    yield app, server.servers[0].sockets[0].getsockname()
    server.should_exit = True
    thread.join()


def test_a_service_is_ready_once_its_parts_are(server):
    app, _ = server
    client = TestClient(app, base_url="http://127.0.0.1:8000")  # its own start is not awaited
    until(lambda: client.get("/readyz").status_code == 200)
    assert client.get("/readyz").json()["disk"] == "ok"
    assert client.get("/healthz").json()["status"] == "ok"


def begin(address, path, body):
    """Send a request and leave its answer unread; return the connection."""
    text = json.dumps(body).encode()
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    connection = socket.create_connection(address)
    connection.sendall(f"{head}Content-Length: {len(text)}\r\n\r\n".encode() + text)
    return connection


def until(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come"
        time.sleep(0.1)


def queries():
    """The processes of queries that run."""
    found = []
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            forked_from = " ".join(child.parent().cmdline())
            is_query = "catalogue.sandbox" in " ".join(child.cmdline())
            if is_query and (
                "--ready" not in child.cmdline() or "catalogue.sandbox" in forked_from
            ):
                found.append(child)
    return found


def test_the_process_of_a_query_ends_when_its_client_leaves(server):
    _, address = server
    connection = begin(address, "/api/v1/sql", {"sql": SLOW})
    until(queries)
    connection.close()
    until(lambda: not queries(), seconds=15.0)


def test_many_queries_at_once_start_few_processes_and_health_answers(server):
    _, address = server
    connections = [begin(address, "/api/v1/sql", {"sql": SLOW}) for _ in range(45)]
    until(queries)
    most, slowest = 0, 0.0
    for _ in range(10):
        begun = time.monotonic()
        with socket.create_connection(address, timeout=20) as probe:
            probe.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            assert probe.recv(15) == b"HTTP/1.1 200 OK"
        slowest = max(slowest, time.monotonic() - begun)
        most = max(most, len(queries()))
    assert 1 <= most <= 4
    assert slowest < 10.0
    refused = [one for one in connections if is_refused(one)]
    assert len(refused) == 45 - 16
    for one in connections:
        one.close()
    until(lambda: not queries())


def is_refused(connection):
    """Whether a request was answered with 429 and when to come again."""
    connection.settimeout(0.2)
    try:
        head = connection.recv(4096).decode().lower()
    except TimeoutError:
        return False
    assert head.startswith("http/1.1 429 ")
    assert "retry-after: " in head
    return True


def test_a_plan_ends_when_its_client_leaves(server):
    app, address = server
    plan = {"n_marks": 20, "is_robust": True, "model": "sensor"}
    connection = begin(address, "/api/v1/plans/optimise", plan)
    places = app.state.service.plans
    until(lambda: places._n == 1)
    time.sleep(1.0)
    connection.close()
    until(lambda: places._n == 0, seconds=30.0)


def test_a_plan_that_takes_too_much_memory_is_refused(tmp_path, scheduler):
    with TestClient(
        create_app(Settings(data=tmp_path, scheduler=scheduler)), base_url="http://127.0.0.1:8000"
    ) as client:
        stops = [{"name": f"s{i}", "x_m": i % 50 * 0.1, "y_m": i // 50 * 0.1} for i in range(1000)]
        answer = client.post("/api/v1/plans/evaluate", json={"marks": MANY, "stops": stops})
        assert answer.status_code == 400
        assert "400,000 pairs" in answer.json()["detail"]
        few = {"marks": MANY[:40], "field_cells": 101, "model": "sensor"}
        field = client.post("/api/v1/plans/evaluate", json=few).json()["field"]
        assert len(field["y_m"]) == len(field["sigma_3d_m"])
