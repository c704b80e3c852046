"""The 3-D view of three million points in a real Chromium: what it loads and draws of them."""

import pytest

from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.clouds.octree import BYTES_PER_POINT
from tests.browser.visits import NEEDS_CHROMIUM, Visit, served
from tests.surveyed import fill

pytestmark = [NEEDS_CHROMIUM, pytest.mark.long]

N_POINTS = 3_000_000
FLOOR = 60_000  # points that a slow computer draws while the view moves
FRAMES = """() => {
  window.frames_drawn = [];
  const place = document.getElementById("cloud");
  new MutationObserver(() => {
    const { points, most } = place.dataset;
    window.frames_drawn.push([Number(points), Number(most)]);
  }).observe(place, { attributes: true, attributeFilter: ["data-points"] });
}"""
LOADED = """() => performance.getEntriesByType("resource")
    .filter((one) => /octree\\/r/.test(one.name)).map((one) => one.decodedBodySize)"""


@pytest.fixture(scope="module")
def address(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "dense", n_stops=1, n_ground=N_POINTS)
    with served(data, scheduler) as address:
        yield address


def test_no_frame_of_three_million_points_has_more_than_its_budget(context, address):
    page = Visit(context.new_page(), address, width=1280).open("/surveys/dense/cloud")
    page.wait_for_selector('#cloud[data-ready][data-loading="0"]', timeout=120_000)
    assert int(page.locator("#cloud").get_attribute("data-total")) > N_POINTS
    whole = page.evaluate(LOADED)
    assert 0 < sum(whole) < BYTES_PER_POINT * N_POINTS / 4  # the whole view needs a part of them
    page.evaluate(FRAMES)
    page.select_option("#cloud-budget", "500000")
    box = page.locator("#cloud-stage canvas").bounding_box()
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    page.mouse.move(*middle)
    page.mouse.wheel(0, -600)  # nearer: more levels of detail
    page.mouse.down()
    for i in range(40):
        page.mouse.move(middle[0] + 8 * i, middle[1] + 2 * i)
    page.mouse.up()
    page.wait_for_selector('#cloud[data-loading="0"]', timeout=120_000)
    frames = page.evaluate("frames_drawn")
    assert len(frames) > 10
    assert all(points <= most <= 500_000 for points, most in frames)
    assert all(most >= FLOOR for _, most in frames)
