import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.positioning.subsets import angles_that_keep, theory_of_pairs
from spheremark.web import theme
from spheremark.web.figures import included_angle as angles

MM = 1e-9  # [mm]; figures only scale
TOLERANCE = 0.03


def rows(n=2, method="along_beam"):
    return {
        "stop": np.array([f"s{i}" for i in range(n)], dtype=object),
        "fit_method": np.array([method] * n, dtype=object),
        "marks": np.array([["P01", f"P{i + 2:02d}"] for i in range(n)], dtype=object),
        "included_angle_deg": np.linspace(20.0, 60.0, n),
        "included_angle_max_deg": np.linspace(40.0, 120.0, n),
        "sigma_horizontal_m": np.full(n, 0.003),
        "error_horizontal_m": np.linspace(0.002, 0.005, n),
    }


def fixes():
    return {
        "fit_method": np.array(["along_beam", "along_beam"], dtype=object),
        "sigma_horizontal_m": np.array([0.001, 0.001]),
        "error_horizontal_m": np.array([0.0003, 0.0004]),
    }


def shown(**changes):
    known = {
        "rows": rows(), "fixes": fixes(), "n_marks": 2, "resection": "free_station",
        "sigma_axis_m": 0.004,
    }  # fmt: skip
    return angles.Subsets(**known | changes)


def trace(figure, start):
    return next(one for one in figure.data if one.name.startswith(start))


def test_few_marks_are_drawn_at_their_widest_angle_and_all_marks_as_a_level_line():
    figure = angles.error_against_angle(shown(), TOLERANCE)
    label = theme.method_style("along_beam").label
    few = trace(figure, f"{label}, two marks")
    assert_allclose(few.x, [40.0, 120.0])
    assert_allclose(few.y, [2.0, 5.0], atol=MM)
    assert_allclose(trace(figure, f"{label}, all marks").y, np.sqrt((0.3**2 + 0.4**2) / 2))
    assert figure.layout.xaxis.title.text == "Included angle [deg]"
    assert figure.layout.yaxis.title.text == "Error, horizontal [mm]"


def test_the_axis_of_triples_names_the_widest_angle():
    figure = angles.error_against_angle(shown(n_marks=3), TOLERANCE)
    assert "widest of three" in figure.layout.xaxis.title.text
    assert trace(figure, theme.method_style("along_beam").label).name.endswith("three marks")


def test_without_truth_predicted_sigmas_are_drawn_and_said_so():
    blind = rows()
    blind["error_horizontal_m"] = np.full(2, np.nan)
    figure = angles.error_against_angle(shown(rows=blind), TOLERANCE)
    assert "Predicted sigma" in figure.layout.yaxis.title.text
    assert_allclose(figure.data[0].y, 3.0, atol=MM)


@pytest.mark.parametrize(
    ("name", "at_right_angle"),
    [("theory, two circles", np.sqrt(2.0)), ("theory, two centres", np.sqrt(1.5))],
)
def test_both_theories_are_drawn_for_the_centres_of_the_survey(name, at_right_angle):
    line = trace(angles.error_against_angle(shown(), TOLERANCE), name)
    assert line.y[line.x.tolist().index(90.0)] == pytest.approx(4.0 * at_right_angle)


@pytest.mark.parametrize(("resection", "n_zones"), [("paper", 2), ("free_station", 0)])
def test_only_the_method_that_has_the_studys_limits_is_shaded_by_them(resection, n_zones):
    figure = angles.error_against_angle(shown(resection=resection), TOLERANCE)
    assert sum(shape.type == "rect" for shape in figure.layout.shapes) == n_zones
    notes = [note.text for note in figure.layout.annotations]
    assert any("study, for circles: 30 to 150 deg" in note for note in notes)


def test_many_rows_are_thinned_and_their_bins_are_not():
    many = rows(20_000)
    figure = angles.error_against_angle(shown(rows=many), TOLERANCE)
    assert len(figure.data[0].x) <= 3000
    own = many["included_angle_max_deg"] < 50.0
    rms = 1e3 * np.sqrt(np.mean(many["error_horizontal_m"][own] ** 2))
    assert figure.data[1].y[0] == pytest.approx(rms)


@pytest.mark.parametrize("is_log", [False, True])
def test_the_tolerance_is_where_its_label_is(is_log):
    figure = angles.error_against_angle(shown(), TOLERANCE, is_log=is_log)
    note = next(n for n in figure.layout.annotations if "tolerance" in n.text)
    assert note.y == pytest.approx(np.log10(30.0) if is_log else 30.0)


def test_limits_are_where_the_theory_meets_the_tolerance():
    for sigma, degrees in ((0.017, 52.0), (0.010, 28.0)):
        least, widest = angles_that_keep("free_station", sigma, TOLERANCE)
        assert np.degrees(least) == pytest.approx(degrees, abs=0.5)
        assert widest == np.pi
        assert theory_of_pairs("free_station", sigma, least) == pytest.approx(TOLERANCE)
    least, widest = angles_that_keep("paper", 0.01, TOLERANCE)
    assert_allclose(theory_of_pairs("paper", 0.01, np.array([least, widest])), TOLERANCE)


@pytest.mark.parametrize("method", ["free_station", "paper"])
def test_centres_as_bad_as_the_tolerance_keep_it_at_no_angle(method):
    assert np.isnan(angles_that_keep(method, 1.01 * TOLERANCE, TOLERANCE)).all()
