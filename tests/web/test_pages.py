import json

import numpy as np
import pytest

from spheremark.web import assets, templating
from spheremark.web.pages import readouts
from spheremark.web.pages.base import Frame


def rows(errors, sigmas, marks, method="along_beam"):
    n = len(errors)
    return {
        "stop": np.array(["s1"] * n, dtype=object),
        "fit_method": np.array([method] * n, dtype=object),
        "mark": np.array(marks, dtype=object),
        "error_3d_m": np.array(errors, dtype=float),
        "sigma_3d_m": np.array(sigmas, dtype=float),
    }


def nothing():
    return rows([], [], [])


def test_the_headline_gives_rms_in_millimetres_and_the_share_within_tolerance():
    fits = rows([0.003, 0.004, 0.040], [0.003] * 3, ["A", "B", "C"])
    first = readouts.headline(fits, nothing(), 0.03)[0]
    assert (first.value, first.unit) == ("23.3", "mm RMS error")
    assert first.note == "2 of 3 within 30 mm, largest 40.0 mm"


def test_the_headline_counts_fits_on_no_mark_apart():
    fits = rows([0.003, np.nan], [0.003, 0.020], ["A", None])
    first = readouts.headline(fits, nothing(), 0.03)[0]
    assert first.value == "3.0"
    assert first.note.endswith("1 on no mark")


def test_without_truth_the_headline_gives_sigma_and_never_error():
    fits = rows([np.nan, np.nan], [0.003, 0.004], ["A", "B"])
    text = str(readouts.headline(fits, fits, 0.03))
    assert "mm predicted sigma" in text
    assert "error" not in text


def test_the_headline_sets_error_against_what_was_predicted():
    last = readouts.headline(rows([0.004], [0.002], ["A"]), nothing(), 0.03)[-1]
    assert (last.value, last.unit) == ("2.0", "mm sigma")
    assert "2.00" in last.note


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
