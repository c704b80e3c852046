"""Every page passes axe, in both themes and at both widths."""

import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.browser.test_pages_in_a_browser import CHROMIUM, PAGES, address, browser, visit

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
__all__ = ["address", "browser", "visit"]  # fixtures

MORE = ["/coverage", "/worlds", "/login", "/guide", "/surveys/none", "/plan/sheet?a=P01:6,0,1"]
LOOKS = [(width, scheme) for width in (1280, 390) for scheme in ("light", "dark")]


def found(page):
    """Return the violations of a page: rule, number of places, and the first of them."""
    violations = Axe().run(page).response["violations"]
    return [(one["id"], len(one["nodes"]), one["nodes"][0]["html"]) for one in violations]


@pytest.mark.parametrize("path", [*PAGES, *MORE])
def test_a_page_passes_axe(visit, path):
    for width, scheme in LOOKS:
        page = visit(width=width, scheme=scheme).open(path)
        page.wait_for_load_state("networkidle")
        assert found(page) == [], (width, scheme)


def test_a_fault_is_found(visit):
    page = visit().open("/glossary")
    page.evaluate("document.querySelector('main').append(document.createElement('button'))")
    assert [one[0] for one in found(page)] == ["button-name"]
