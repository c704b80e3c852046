import json

import pytest

from spheremark.web import assets, templating
from spheremark.web.pages.base import Frame


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("gimbal_speed_deg_per_s", "Gimbal speed [deg/s]"),
        ("rate_hz", "Rate [Hz]"),
        ("n_returns", "Returns"),
        ("has_shot_times", "Shot times"),
    ],
)
def test_keys_become_headings_with_units(key, text):
    assert templating.heading(key) == text


def test_json_in_a_page_cannot_end_the_element_that_holds_it():
    block = templating.json_block({"name": "</script><b>&"})
    assert "<" not in block
    assert json.loads(block) == {"name": "</script><b>&"}


def test_the_error_page_escapes_its_texts():
    problem = {"status": 404, "title": "Not there.", "code": "not_found"}
    problem["detail"] = "There is no <script>."
    text = templating.render("error.html", frame=Frame(surveys=("<i>",)), problem=problem)
    assert "There is no &lt;script&gt;." in text
    assert "<i>" not in text


def test_addresses_of_files_change_with_their_content():
    assert assets.url("site.css").endswith(assets.digest())
    assert assets.static_folder().joinpath("site.css").is_file()


def test_the_element_of_map_styles_has_the_id_that_plotly_looks_for():
    assert f'getElementById("{assets.map_style_id()}")' in assets.plotly_script().read_text("utf-8")
