"""One service and one browser for each file of this folder."""

import pytest
from playwright.sync_api import sync_playwright

from spheremark.storage.catalogue.catalogue import Catalogue
from tests.browser.visits import CHROMIUM, Visit, served
from tests.surveyed import fill


@pytest.fixture(scope="module")
def address(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
        fill(catalogue, data / "clouds", "blind", n_stops=1, with_truth=False, lane="a")
    with served(data, scheduler) as address:
        yield address


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def context(browser):
    return browser.new_context()


@pytest.fixture
def visit(context, address):
    visits = []

    def start(**look):
        tabs = context.pages[len(visits) :] or [context.new_page()]
        visits.append(Visit(tabs[0], address, **look))
        return visits[-1]

    yield start
    for one in visits:
        one.end()
    for tab in context.pages[1:]:
        tab.close()
