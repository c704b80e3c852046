"""Figures, tables and clouds in a real Chromium: links lead, and one thing lights up everywhere."""

import pytest

from tests.browser.visits import NEEDS_CHROMIUM

pytestmark = NEEDS_CHROMIUM

ACCURACY = "/surveys/field/accuracy"
POINT = """(name) => {
  const place = document.querySelector(`#${name} .plot`);
  const trace = place.data.find((one) => one.ids?.length && one.ids[0].startsWith("/"));
  const [x, y] = [place._fullLayout.xaxis, place._fullLayout.yaxis];
  const box = place.getBoundingClientRect();
  const value = (list) => (Array.isArray(list) ? list : Array.from(list))[0];
  return {
    link: trace.ids[0],
    x: box.left + x._offset + x.d2p(value(place._fullData[place.data.indexOf(trace)].x)),
    y: box.top + y._offset + y.d2p(value(place._fullData[place.data.indexOf(trace)].y)),
  };
}"""


def opened(visit, path, **look):
    one = visit(**look)
    page = one.open(path)
    page.wait_for_selector("[data-table][data-drawn]")
    return one, page


def test_a_dot_leads_to_its_marker(visit):
    _, page = opened(visit, ACCURACY)
    page.locator("#map .plot").scroll_into_view_if_needed()
    at = page.evaluate(POINT, "map")
    page.mouse.move(at["x"], at["y"])
    page.wait_for_selector("#map .plot.linked")
    with page.expect_navigation():
        page.mouse.click(at["x"], at["y"])
    assert page.url.endswith(at["link"])


def test_a_row_lights_up_the_same_stop_in_the_map(visit):
    one, page = opened(visit, ACCURACY)
    row = page.locator("[data-table] tbody tr").first
    row.hover()
    assert "spot" in row.get_attribute("class")
    page.wait_for_selector("#map .hovertext")
    stop = row.locator("a").text_content()
    assert stop in page.locator("#map .hovertext").first.text_content()
    assert one.complaints == []


def test_a_heading_sorts_and_the_address_keeps_order_and_part(visit):
    _, page = opened(visit, ACCURACY)
    page.get_by_role("button", name="Distance").click()
    page.wait_for_selector('th[aria-sort="descending"]:has-text("Distance")')
    page.get_by_role("button", name="Next").click()
    page.wait_for_selector('.pages:has-text("26 to")')
    found = page.locator("[data-table] tbody tr").first.text_content()
    assert "after=25" in page.url
    page.reload()
    page.wait_for_selector("[data-table][data-drawn]")
    assert page.locator("[data-table] tbody tr").first.text_content() == found


def test_a_table_of_a_page_is_sorted_by_its_headings(visit):
    page = visit().open("/surveys/field/logs")
    table = page.locator('[aria-labelledby="control-head"] table')

    def column(i):
        return [row.locator("td").nth(i).inner_text() for row in table.locator("tbody tr").all()]

    heights = sorted(column(3), key=float)
    table.locator("th").nth(3).click()
    assert column(3) == heights[::-1]
    table.get_by_role("button", name="Sort by z").press("Enter")
    assert column(3) == heights
    assert table.locator("th").nth(3).get_attribute("aria-sort") == "ascending"
    table.get_by_role("button", name="Sort by Mark").press("Enter")
    assert column(0) == [f"S{i:02d}" for i in range(1, 15)]


def test_a_median_filters_the_page_to_its_bin(visit):
    _, page = opened(visit, ACCURACY)
    link = page.evaluate(
        """() => document.querySelector("#distance .plot").data
            .flatMap((one) => one.ids ?? []).find((one) => one.startsWith("?"))"""
    )
    page.goto(page.url + link)
    assert page.locator('[name="range_from_m"]').input_value() != ""
    page.wait_for_selector("[data-table][data-drawn]")
    assert "of 28" not in page.locator(".pages").text_content()


@pytest.mark.parametrize(
    ("form", "begin"), [("PNG", b"\x89PNG"), ("SVG", b"<svg"), ("Data, CSV", b'"fit')]
)
def test_a_figure_is_saved_from_its_menu(visit, form, begin):
    _, page = opened(visit, ACCURACY)
    page.locator("#distance .menu summary").click()
    with page.expect_download() as download:
        page.locator("#distance .menu").get_by_text(form, exact=True).click()
    assert download.value.path().read_bytes().startswith(begin)


def test_the_query_of_a_figure_opens_on_the_page_for_sql(visit):
    _, page = opened(visit, ACCURACY)
    page.locator("#count .menu summary").click()
    with page.expect_navigation():
        page.locator("#count .menu").get_by_text("SQL that made it").click()
    assert "/sql?q=WITH" in page.url
    page.wait_for_selector("#result tbody tr")


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_cloud_is_drawn_and_measured(visit, width, scheme):
    one = visit(width=width, scheme=scheme)
    page = one.open("/surveys/field/cloud")
    page.wait_for_selector('#cloud[data-ready][data-loading="0"]')
    page.wait_for_function("Number(document.getElementById('cloud').dataset.points) > 1000")
    assert page.locator(".cloud-label:visible").count() > 3
    page.get_by_role("button", name="Measure").click()
    page.locator("#cloud-status").scroll_into_view_if_needed()
    box = page.locator("#cloud-stage canvas").bounding_box()
    status = page.locator("#cloud-status")
    for i in range(100):  # the cloud of this test is sparse: some places have no point
        right, down = 0.3 + 0.05 * (i % 10), 0.5 + 0.04 * (i // 10)
        page.mouse.click(box["x"] + right * box["width"], box["y"] + down * box["height"])
        if "horizontal" in status.text_content():
            break
    assert "along x, y, z" in status.text_content()
    assert one.complaints == []
    assert one.strangers == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_two_methods_are_chosen_and_compared(visit):
    one = visit()
    page = one.open("/compare")
    page.select_option("#kind", "method")
    page.select_option("#a", "method:field/along_beam")
    page.select_option("#b", "method:field/paper")
    page.get_by_role("button", name="Compare").click()
    page.wait_for_selector("#rows-head")
    assert one.complaints == []
