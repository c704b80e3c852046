"""Every page draws, stays on this host, fits, and passes axe in both themes and at both widths."""

import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.browser.visits import NEEDS_CHROMIUM, PAGES, Visit

pytestmark = NEEDS_CHROMIUM

NOWHERE = ("/surveys/none", "/nowhere")
MORE = [
    "/coverage", "/worlds", "/login", "/guide/sql", *NOWHERE,
    "/sql", "/plan", "/plan/sheet?a=P01:6,0,1",
]  # fmt: skip
LOOKS = [(390, "dark"), (390, "light"), (1280, "light"), (1280, "dark")]  # the first loads
WIDE = 1440  # pages only have to fit there
DRAWN = """(theme) => document.documentElement.dataset.theme === theme
    && [...document.querySelectorAll("[data-figure]")].every(
        (one) => [theme, "failed"].includes(one.dataset.drawn))"""


ALL = {"resultTypes": ["violations"]}
"""All rules, without a list of the places that keep them."""

COLOURS = {**ALL, "runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
"""The rules whose outcome a theme can change."""


def found(page, options=ALL):
    """Return the violations of a page: rule, number of places, and the first of them."""
    axe = Axe("'kept'") if page.evaluate("'axe' in window") else Axe()  # its script is large
    violations = axe.run(page, options=options).response["violations"]
    return [(one["id"], len(one["nodes"]), one["nodes"][0]["html"]) for one in violations]


@pytest.fixture(scope="module", params=[*PAGES, *MORE])
def shown(context, address, request):
    """Show a page once: theme and width change later as for its reader."""
    tab = (context.pages or [context.new_page()])[0]
    one = Visit(tab, address, width=LOOKS[0][0], scheme=LOOKS[0][1])
    page = one.open(request.param)
    for plot in page.locator("[data-figure]").all():
        plot.scroll_into_view_if_needed()  # figures by address are fetched when they come in view
        plot.locator("svg.main-svg, canvas, p.empty").first.wait_for()  # or: nothing to draw
    yield one
    one.end()


def test_a_page_passes_axe_and_is_no_wider_than_the_window(shown):
    page = shown.page
    for width, scheme in LOOKS:
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        page.wait_for_function(DRAWN, arg=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, (width, scheme)
        assert found(page, COLOURS if scheme == "dark" else ALL) == [], (width, scheme)
    page.set_viewport_size({"width": WIDE, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth") <= WIDE


def test_a_page_draws_without_complaint_and_asks_no_other_host(shown):
    """Neither while it loads nor when theme and width change; it is seen after those changes."""
    shown.page.wait_for_load_state("networkidle")
    # Chromium itself names the page that is not there
    absent = [True] * shown.page.url.endswith(NOWHERE)
    assert ["404" in one for one in shown.complaints] == absent
    assert shown.strangers == []


def test_a_fault_is_found(visit):
    page = visit().open("/glossary")
    page.evaluate("document.querySelector('main').append(document.createElement('button'))")
    assert [one[0] for one in found(page)] == ["button-name"]
    assert found(page, COLOURS) == []
    page.evaluate("document.querySelector('main p').style.color = '#c8c8c8'")
    assert [one[0] for one in found(page, COLOURS)] == ["color-contrast"]
