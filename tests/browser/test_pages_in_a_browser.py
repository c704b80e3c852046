"""Pages in a real Chromium do what their readers ask."""

import re
import time
from contextlib import contextmanager
from urllib.parse import urlencode

import numpy as np
import psutil
import pytest

from tests.browser.visits import NEEDS_CHROMIUM, PAGES
from tests.service.conftest import is_worker
from tests.storage.recorder import record, small_log

pytestmark = NEEDS_CHROMIUM


def test_the_toggle_redraws_the_figures_and_is_remembered(visit):
    one = visit()
    page = one.open("/surveys/field/accuracy")
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.click("#theme-toggle")
    page.wait_for_selector("#distance [data-drawn=dark]")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != ground
    assert one.open("/sql").evaluate("document.documentElement.dataset.theme") == "dark"


def test_a_filter_is_in_the_address(visit):
    page = visit().open("/surveys/field/accuracy")
    page.select_option("#status", "weak")
    page.get_by_role("button", name="Show", exact=True).click()
    page.wait_for_url(re.compile(r"status=weak"))
    page.get_by_role("link", name="Show all").click()
    page.wait_for_url(re.compile(r"accuracy[?]?$"))


def test_a_query_in_the_address_runs_and_is_charted(visit):
    page = visit().open(PAGES[-1])
    page.wait_for_selector("#result-full:not([hidden])")
    assert page.locator("#result tbody tr").count() == 6
    assert page.locator("#result thead").inner_text().split() == [
        "stop",
        "x_m",
        "[m]",
        "y_m",
        "[m]",
    ]
    page.wait_for_selector("#chart-plot svg.main-svg")


def test_a_query_is_written_run_and_kept_by_keyboard_alone(visit):
    page = visit().open("/sql")
    page.wait_for_selector(".cm-content")
    page.focus(".cm-content")
    page.keyboard.press("Control+a")
    page.keyboard.type("SELECT 42 AS answer_m")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#result tbody td")
    assert page.locator("#result tbody td").inner_text() == "42"
    assert "SELECT+42" in page.url
    assert page.locator("#history li").count() == 1


def test_a_query_with_a_parameter_is_kept_shared_explained_and_taken_elsewhere(visit):
    page = visit().open("/sql?q=SELECT+stop+FROM+stops+WHERE+stop+%3D+$stop&p=stop%3Dlane3-stop1")
    page.wait_for_selector("#result tbody td")
    assert page.locator("#result tbody td").all_inner_texts() == ["lane3-stop1"]
    page.locator("#parameters input").fill("nowhere")
    page.locator("#run").click()
    page.wait_for_selector("#result-count:has-text('0 rows')")
    assert "p=stop%3Dnowhere" in page.url
    assert "stop%3Dnowhere" in page.locator("#get-parquet").get_attribute("href")
    page.locator("[data-copy=notebook]").click()
    lines = page.locator("#copied").inner_text().splitlines()
    assert len(lines) == 3
    found = {}
    exec("\n".join([*lines[:2], f"rows = {lines[2]}"]), found)  # as in a notebook
    assert found["rows"].columns.tolist() == ["stop"]
    page.locator("#explain").click()
    page.wait_for_selector("#result-plan:not([hidden])")
    assert (
        page.locator("#result-plan")
        .inner_text()
        .startswith("\N{BOX DRAWINGS LIGHT ARC DOWN AND RIGHT}")
    )
    page.locator("#save-name").fill("one stop")
    page.locator("#save-form button[type=submit]").click()
    page.wait_for_selector("#saved a[aria-current]")
    assert "name=one+stop" in page.url
    page.locator("#delete-saved").click()
    page.wait_for_selector("#saved[hidden]", state="attached")


def test_a_query_that_runs_can_be_cancelled(visit):
    page = visit().open("/sql")
    page.wait_for_selector(".cm-content")
    long = "SELECT count(*) FROM range(100000000) AS a, range(999) AS b WHERE a.range % 7 = b.range"
    page.goto(f"{page.url}?{urlencode({'q': long})}")
    page.locator("#cancel").click()
    page.wait_for_selector("#result-error:not([hidden])")
    assert page.locator("#result-error").inner_text() == "Cancelled."


def test_a_query_that_cannot_run_says_why(visit):
    page = visit().open("/sql?q=DROP+TABLE+stops")
    page.wait_for_selector("#result-error:not([hidden])")
    assert "SELECT" in page.locator("#result-error").inner_text()


def test_a_file_that_is_no_log_is_refused_with_its_reason(visit, tmp_path):
    log = tmp_path / "notes.mcap"
    log.write_bytes(b"this is not a log" * 100)
    page = visit(width=390).open("/")
    page.select_option("#upload-survey", "")
    page.set_input_files("#files", log)
    page.wait_for_selector("#uploads .outcome:has-text('refused'), #uploads .outcome.bad")
    assert page.locator("#uploads li").count() == 1
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    held = visit()
    about = held.open(page.get_by_role("link", name="What the log holds").get_attribute("href"))
    about.wait_for_load_state("networkidle")
    assert held.complaints == []
    assert not about.get_by_role("button", name="Process").count()


def test_a_survey_is_made_from_nothing_renamed_deleted_and_restored(visit, tmp_path):
    page = visit().open("/new")
    page.fill("#name", "quarry")
    page.fill("#tolerance", "20")
    page.get_by_role("button", name="Continue").click()
    page.locator("summary", has_text="paste").click()
    page.fill("#control-text", "A,1,2,3\nB,4,5")
    page.wait_for_selector("#control-error:not([hidden])")
    assert page.locator("#use-control").is_disabled()
    page.fill("#control-text", "A,1000,2000,3000\nB,4000,5000,3000\nC,0,9000,1000")
    page.select_option("[name=unit]", "mm")
    page.locator("#control-preview td", has_text=re.compile("^1.0000$")).first.wait_for()
    assert page.locator("#control-preview circle").count() == 3
    assert page.locator("#control-preview tbody tr").first.inner_text().split()[:3] == [
        "A", "1.0000", "2.0000"]  # fmt: skip
    page.click("#use-control")
    log = tmp_path / "notes.mcap"
    log.write_bytes(b"this is not a log" * 400_000)  # more than one part
    page.locator("#choose").wait_for(state="visible")
    held = []
    page.route(
        "**/api/v1/uploads/*", lambda route: held.append(route)
    )  # no part arrives before the pause
    page.set_input_files("#files", log)
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Resume").wait_for()
    assert not page.locator("#uploads .outcome.bad").count()
    page.unroute("**/api/v1/uploads/*")
    page.get_by_role("button", name="Resume").click()
    page.wait_for_selector("#uploads .outcome.bad")
    page.click("#finish")
    page.wait_for_url(re.compile("/surveys/quarry$"))
    page.get_by_role("link", name="Logs", exact=True).click()
    page.locator('[aria-labelledby="control-head"] tbody tr').nth(2).wait_for()
    page.fill("#survey-name", "pit")
    page.get_by_role("button", name="Save").click()
    page.wait_for_url(re.compile("/surveys/pit/logs$"))
    page.click("#delete-survey")
    page.wait_for_url(re.compile("deleted="))
    page.get_by_role("button", name="Restore").click()
    page.wait_for_url(re.compile("/surveys/pit$"))


def test_logs_that_are_dropped_together_all_arrive(visit, tmp_path):
    names = ["first.mcap", "second.mcap", "third.mcap"]
    for i, name in enumerate(names):
        record(tmp_path / name, small_log(np.random.default_rng(i)))

    def slowly(route):
        time.sleep(1.0)  # longer than the page waits before it shows the logs anew
        route.continue_()

    page = visit().open("/surveys/field/logs")
    page.route("**/api/v1/recordings?*", slowly)
    page.set_input_files("#files", [tmp_path / name for name in names])
    table = page.locator('[aria-labelledby="logs-head"]')
    for name in names:
        table.get_by_role("link", name=name.removesuffix(".mcap"), exact=True).wait_for()


def test_a_log_that_is_removed_can_be_put_back_at_once(visit):
    page = visit().open("/surveys/field/logs")
    rows = page.locator('[aria-labelledby="logs-head"] tbody tr')
    n = rows.count()
    page.get_by_role("button", name="Remove").first.click()
    page.get_by_role("button", name="Undo").wait_for()
    assert rows.count() == n - 1
    page.get_by_role("button", name="Undo").click()
    page.wait_for_function(
        "n => document.querySelectorAll('[aria-labelledby=logs-head] tbody tr').length === n", arg=n
    )


def test_jobs_are_at_hand_on_every_page(visit):
    page = visit(width=390).open("/sql")
    page.wait_for_load_state("networkidle")
    page.click("#jobs-toggle")
    page.locator("#jobs-list li a").first.wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.keyboard.press("Escape")
    assert page.locator("#jobs-drawer").is_hidden()


KEEP_WHAT_CHANGES = """() => {
  for (const part of ["attempts", "started"]) {
    const place = document.querySelector(`[data-part=${part}]`);
    const keep = () => sessionStorage.setItem(part, place.textContent);
    new MutationObserver(keep).observe(place, {childList: true, characterData: true});
  }
}"""


@contextmanager
def workers_at_rest():
    """Keep the workers of the service from starting a job."""
    found = [one for one in psutil.Process().children(recursive=True) if is_worker(one)]
    assert found
    for one in found:
        one.suspend()
    try:
        yield
    finally:
        for one in found:
            one.resume()


def test_the_page_of_a_job_says_when_it_began_without_being_loaded_again(visit):
    one = visit()
    request = {"kind": "adjust", "survey": "field"}
    with workers_at_rest():
        job = one.page.context.request.post(f"{one.address}/api/v1/jobs", data=request).json()
        assert job["attempts"] == 0
        page = one.open(f"/jobs/{job['job_id']}")
        page.evaluate(KEEP_WHAT_CHANGES)
    page.wait_for_selector(".notice.bad")  # its log is not on this disk: the page is loaded again
    kept = page.evaluate("({...sessionStorage})")  # from the first page, however briefly it showed
    assert kept["attempts"] == "1"
    began = kept["started"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC", began)


def test_a_mark_that_is_dragged_moves_the_prediction_and_the_address(visit):
    page = visit().open("/plan?model=sensor&a=P01:6.5,0.5,1;P02:-1,6.5,1;P03:-6.5,-3,1")
    worst = page.locator(".plan .readout dd").first
    page.wait_for_selector("#stops-table tbody tr")
    before = worst.inner_text()
    box = page.locator("[data-key='mark P02'] circle").nth(1).bounding_box()
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 60, steps=4)
    page.mouse.up()
    page.wait_for_function(
        "before => document.querySelector('.plan .readout dd').innerText !== before", arg=before
    )
    assert "P02%3A-1%2C6.5" not in page.url
    page.keyboard.press("Delete")
    page.wait_for_function("() => document.querySelectorAll('#marks-table tbody tr').length === 2")
    page.click("#undo")
    page.wait_for_function("() => document.querySelectorAll('#marks-table tbody tr').length === 3")


def test_a_stop_that_is_chosen_shows_what_each_mark_does_for_it(visit):
    page = visit().open("/plan?model=sensor&a=P01:6.5,0.5,1;P02:-1,6.5,1;P03:-6.5,-3,1")
    page.get_by_role("button", name="lane3-stop4", exact=True).click()
    table = page.locator("#marks-at-stop tbody tr")
    table.nth(2).wait_for()
    redundancies = [float(row.locator("td").nth(6).inner_text()) for row in table.all()]
    text = page.locator("#marks-at-stop p").inner_text()
    x, y, z, all_axes, _ = map(float, re.findall(r"\d+\.\d+", text))
    assert np.linalg.norm([x, y, z]) == pytest.approx(all_axes, abs=0.01)
    dof = int(re.search(r"(\d+) degrees", text)[1])
    # two more are those of levelling, one is that of the error that all ranges share
    assert sum(redundancies) == pytest.approx(dof - 3, abs=0.1)
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 720, "height": 1000})
    widths = page.evaluate(
        "['#planner', '#stops-table'].map(q => document.querySelector(q).offsetWidth)"
    )
    assert widths[1] <= widths[0]


def test_no_mark_is_put_where_an_area_was_drawn(visit):
    page = visit().open("/plan?model=sensor&a=P01:6.5,0.5,1;P02:-1,6.5,1;P03:-6.5,-3,1")
    page.wait_for_selector("#stops-table tbody tr")
    page.click("#add-area")
    svg = page.locator(".plan .map svg")
    box = svg.bounding_box()
    for x, y in ((0.02, 0.02), (0.5, 0.02), (0.5, 0.98), (0.02, 0.98)):  # the left half
        svg.click(position={"x": x * box["width"], "y": y * box["height"]})
    page.click("#finish-area")
    page.fill("#count", "4")
    page.click("#optimise")
    page.wait_for_selector("#marks-table tbody tr:nth-child(4)")
    fields = page.get_by_role("spinbutton", name=re.compile("^x of P"))
    assert all(float(field.input_value()) > -0.6 for field in fields.all())
    assert "keep=" in page.url
    page.reload()
    page.locator("[data-key='area 0']").focus()
    page.keyboard.press("Delete")
    page.wait_for_function("() => !location.search.includes('keep=')")


def test_a_search_shows_its_progress_and_then_its_own_evaluation(visit):
    page = visit().open("/plan?model=sensor&stops=A:0,0;B:3,1&spacing=3")
    page.wait_for_selector("#stops-table tbody tr")
    page.fill("#count", "4")
    page.click("#optimise")
    page.wait_for_selector("#plan-search progress")
    assert "/plan/search/" in page.get_attribute("#plan-search a", "href")
    page.wait_for_selector("#plan-news:not([hidden])", timeout=120_000)
    assert "none has less than" in page.inner_text("#plan-news")
    assert page.inner_text(".plan h2") == "4 marks"
    assert page.locator("#stops-table tbody tr").count() == 2
    assert not page.is_visible("#plan-search")
