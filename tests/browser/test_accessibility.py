"""Every page passes axe, in both themes and at both widths."""

import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.browser.visits import NEEDS_CHROMIUM, PAGES

pytestmark = NEEDS_CHROMIUM

MORE = ["/coverage", "/worlds", "/login", "/guide/sql", "/surveys/none", "/plan/sheet?a=P01:6,0,1"]
LOOKS = [(1280, "light"), (1280, "dark"), (390, "dark"), (390, "light")]
DRAWN = """(theme) => document.documentElement.dataset.theme === theme
    && [...document.querySelectorAll("[data-figure]")].every(
        (one) => [theme, "failed"].includes(one.dataset.drawn))"""


ALL = {"resultTypes": ["violations"]}
"""All rules, without a list of the places that keep them."""

COLOURS = {**ALL, "runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
"""The rules whose outcome a theme can change."""


def found(page, options=ALL):
    """Return the violations of a page: rule, number of places, and the first of them."""
    violations = Axe().run(page, options=options).response["violations"]
    return [(one["id"], len(one["nodes"]), one["nodes"][0]["html"]) for one in violations]


@pytest.mark.parametrize("path", [*PAGES, *MORE])
def test_a_page_passes_axe(visit, path):
    """The page is loaded once: theme and width change as for its reader."""
    page = visit(width=LOOKS[0][0], scheme=LOOKS[0][1]).open(path)
    page.wait_for_load_state("networkidle")
    for width, scheme in LOOKS:
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        page.wait_for_function(DRAWN, arg=scheme)
        assert found(page, COLOURS if scheme == "dark" else ALL) == [], (width, scheme)


def test_a_fault_is_found(visit):
    page = visit().open("/glossary")
    page.evaluate("document.querySelector('main').append(document.createElement('button'))")
    assert [one[0] for one in found(page)] == ["button-name"]
    assert found(page, COLOURS) == []
    page.evaluate("document.querySelector('main p').style.color = '#c8c8c8'")
    assert [one[0] for one in found(page, COLOURS)] == ["color-contrast"]
