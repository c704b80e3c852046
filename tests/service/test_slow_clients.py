"""Clients that send slowly, or nothing: their connections end, and others are served."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest
import uvicorn

from spheremark.service.http import protocol, security
from spheremark.service.http.app import create_app
from spheremark.service.http.security import HEADERS
from spheremark.service.settings import Settings


@pytest.fixture(scope="module")
def address(tmp_path_factory, scheduler):
    """A service on a real port, with limits of time that a test can wait for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "HEADER_SECONDS", 0.5)
        patch.setattr(security, "IDLE_SECONDS", 0.5)
        patch.setattr(security, "BODY_SECONDS", 1.5)
        app = create_app(Settings(data=tmp_path_factory.mktemp("data"), scheduler=scheduler))
        config = uvicorn.Config(
            app,
            port=0,
            http="spheremark.service.http.protocol:BoundedProtocol",
            log_level="critical",
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(server.serve()), daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.05)
        yield server.servers[0].sockets[0].getsockname()
        server.should_exit = True
        thread.join()


def answer_to(address, *parts, pause=0.0):
    """Send parts, and return what comes back until the connection ends."""
    found = b""
    with socket.create_connection(address, timeout=30) as connection:
        with contextlib.suppress(ConnectionError):
            for part in parts:
                connection.sendall(part)
                time.sleep(pause)
        with contextlib.suppress(ConnectionError):
            while data := connection.recv(65536):
                found += data
    return found.decode()


HOST = b"Host: localhost\r\n"
LOG = (
    b"POST /api/v1/recordings?name=a HTTP/1.1\r\n"
    + HOST
    + b"Content-Type: application/vnd.mcap\r\n"
)


def has_headers(answer):
    head = answer.partition("\r\n\r\n")[0].lower()
    return all(f"{name.lower()}: {value.lower()}" in head for name, value in HEADERS.items())


def test_a_connection_without_a_request_is_closed(address):
    assert answer_to(address) == ""


@pytest.mark.parametrize("head", [b"GET / HT", b"GET / HTTP/1.1\r\n" + HOST + b"X-Slow: 1"])
def test_a_header_that_does_not_end_is_refused(address, head):
    answer = answer_to(address, head)
    assert answer.startswith("HTTP/1.1 408 ")
    assert has_headers(answer)


def test_a_header_that_comes_byte_by_byte_is_refused(address):
    begun = time.monotonic()
    answer = answer_to(address, *[b"G", b"E", b"T", b" ", b"/", b" ", b"H", b"T"] * 2, pause=0.2)
    assert time.monotonic() - begun < 10
    assert "200 OK" not in answer


def test_what_is_no_http_is_refused_with_the_headers(address):
    answer = answer_to(address, b"\x16\x03\x01\x02\x00\x01\r\n\r\n")
    assert answer.startswith("HTTP/1.1 400 ")
    assert has_headers(answer)


@pytest.mark.parametrize(
    "head",
    [
        LOG + b"Content-Length: 1000000\r\n\r\n",
        LOG + b"Transfer-Encoding: chunked\r\n\r\n",
        b"POST /api/v1/sql HTTP/1.1\r\n" + HOST
        + b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n",
    ],
)  # fmt: skip
def test_a_body_that_stops_coming_is_refused(address, head):
    answer = answer_to(address, head + b"1\r\n")
    assert answer.startswith("HTTP/1.1 408 ")
    assert "input.timeout" in answer
    assert has_headers(answer)


def test_a_body_of_a_byte_at_a_time_is_refused(address):
    head = LOG + b"Content-Length: 1000000\r\n\r\n"
    begun = time.monotonic()
    answer = answer_to(address, head, *[b"x"] * 20, pause=0.2)
    assert time.monotonic() - begun < 15
    assert "408" in answer.partition("\r\n")[0]


def test_one_connection_serves_request_after_request(address):
    get = b"GET /healthz HTTP/1.1\r\n" + HOST + b"\r\n"
    last = get.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
    assert answer_to(address, get, get, last, pause=0.3).count("HTTP/1.1 200 OK") == 3


def test_others_are_served_beside_many_that_send_nothing(address):
    idle = [socket.create_connection(address) for _ in range(100)]
    get = b"GET /healthz HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n"
    assert answer_to(address, get).startswith("HTTP/1.1 200 OK")
    for one in idle:
        one.settimeout(10)
        assert one.recv(100) == b""
        one.close()
