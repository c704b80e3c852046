"""One service and one browser for all tests of this folder."""

import threading
import time

import pytest
import uvicorn
from playwright.sync_api import sync_playwright

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.browser.visits import CHROMIUM, Visit
from tests.surveyed import fill


@pytest.fixture(scope="package")
def address(tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
        fill(catalogue, data / "clouds", "blind", n_stops=1, with_truth=False, lane="a")
    app = create_app(Settings(data=data, workers=1))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive(), "The service did not start."
        time.sleep(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(timeout=120)


@pytest.fixture(scope="package")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def visit(browser, address):
    visits = []

    def start(**look):
        visits.append(Visit(browser, address, **look))
        return visits[-1]

    yield start
    for one in visits:
        one.context.close()
