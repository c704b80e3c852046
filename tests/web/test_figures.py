import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.config import FITTING_METHODS
from spheremark.pipelines.published import TABLE_2
from spheremark.web import theme
from spheremark.web.assets import static_folder
from spheremark.web.columns import lane_and_number
from spheremark.web.figures import elements, maps
from spheremark.web.figures import survey as figures
from spheremark.web.figures.solution import heights, solution_map

MM = 1e-9  # [mm]; figures only scale


def fits(n=40, *, with_errors=True, methods=("along_beam", "paper")):
    rng = np.random.default_rng(3)
    n_all = n * len(methods)
    return {
        "stop": np.array([f"lane3-stop{i % 7 + 1}" for i in range(n_all)], dtype=object),
        "fit_method": np.repeat(np.array(methods, dtype=object), n),
        "marker": np.array([f"M{i % 14 + 1:02d}" for i in range(n_all)], dtype=object),
        "mark": np.array(["P01"] * n_all, dtype=object),
        "status": np.array((["ok"] * (n - 1) + ["weak"]) * len(methods), dtype=object),
        "reason": np.array([""] * n_all, dtype=object),
        "range_m": rng.uniform(3, 13, n_all),
        "n_points": rng.integers(30, 600, n_all).astype(np.int32),
        "sigma_3d_m": rng.uniform(0.001, 0.004, n_all),
        "error_3d_m": rng.uniform(0, 0.03, n_all) if with_errors else np.full(n_all, np.nan),
    }


def fixes(n=3):
    return {
        "stop": np.array([f"lane3-stop{i + 1}" for i in range(n)], dtype=object),
        "fit_method": np.array(["along_beam"] * n, dtype=object),
        "status": np.array(["ok"] * n, dtype=object),
        "x_m": np.linspace(-4.0, 4.0, n),
        "y_m": np.zeros(n),
        "z_m": np.ones(n),
        "sigma_3d_m": np.full(n, 0.002),
        "error_3d_m": np.full(n, 0.001),
        "ellipse_major_95_m": np.full(n, 0.004),
        "ellipse_minor_95_m": np.full(n, 0.002),
        "ellipse_bearing_deg": np.full(n, 90.0),
        "included_angle_min_deg": np.full(n, 20.0),
        "n_markers": np.full(n, 14),
    }


def marks():
    return {
        "mark": np.array(["P01", "P02", "P03"], dtype=object),
        "x_m": np.array([8.0, -8.0, 0.0]),
        "y_m": np.array([0.0, 0.0, 8.0]),
        "z_m": np.ones(3),
    }


def stations(n=1, **changes):
    shared = {name: column for name, column in fixes(n).items() if name != "fit_method"}
    errors = dict.fromkeys(("error_x_m", "error_y_m", "error_z_m"), np.full(n, 0.001))
    names = {"survey": np.array(["field"] * n, dtype=object), "station": shared["stop"]}
    given = {name: np.array(column) for name, column in changes.items()}
    return shared | errors | names | {"sigma_z_m": np.full(n, 0.001)} | given


def trace(figure, name):
    return next(one for one in figure.data if one.name == name)


def test_errors_in_metres_are_drawn_in_millimetres_against_metres():
    columns = fits()
    figure = figures.error_against_distance(columns, 0.03)
    drawn = trace(figure, theme.method_style("along_beam").label)
    assert_allclose(drawn.x, columns["range_m"][:40])
    assert_allclose(drawn.y, 1000 * columns["error_3d_m"][:40], atol=MM)
    assert figure.layout.xaxis.title.text == "Distance [m]"
    assert figure.layout.yaxis.title.text == "Error, 3-D [mm]"


def test_without_truth_the_figure_shows_sigma_and_names_it():
    columns = fits(with_errors=False)
    figure = figures.error_against_count(columns, 0.03)
    drawn = trace(figure, theme.method_style("paper").label)
    assert_allclose(drawn.y, 1000 * columns["sigma_3d_m"][40:], atol=MM)
    assert figure.layout.title.text.startswith("Predicted sigma of")
    assert figure.layout.yaxis.title.text == "Predicted sigma, 3-D [mm]"
    assert "error" not in str(figure.layout.title.text).lower()


@pytest.mark.parametrize("is_log", [False, True])
def test_the_tolerance_is_drawn_where_it_is(is_log):
    figure = figures.error_against_distance(fits(), 0.025, is_log=is_log)
    line, note = figure.layout.shapes[0], figure.layout.annotations[0]
    assert line.y0 == line.y1 == pytest.approx(25.0)
    assert note.text == "tolerance 25 mm"
    assert note.y == pytest.approx(np.log10(25.0) if is_log else 25.0)
    assert line.line.color == theme.TOLERANCE


def test_weak_fits_are_hollow():
    drawn = figures.error_against_distance(fits(), 0.03).data[0]
    assert drawn.marker.symbol[-1] == "circle-open"
    assert set(drawn.marker.symbol[:-1]) == {"circle"}


def test_a_fit_without_error_is_not_drawn_among_errors():
    columns = fits()
    columns["error_3d_m"][0], columns["range_m"][0] = np.nan, 34.0
    figure = figures.error_against_distance(columns, 0.03)
    assert len(figure.data[0].x) == 39
    assert max(max(one.x) for one in figure.data) < 14.0


def test_bins_give_the_root_mean_square_of_what_is_known():
    middles, values = elements.binned_rms(
        np.array([1.2, 1.4, 2.5, 2.6]), np.array([3.0, 4.0, 2.0, np.nan]), 1.0
    )
    assert_allclose(middles, [1.3, 2.5])
    assert_allclose(values, [np.sqrt(12.5), 2.0])


def test_the_lane_figure_shows_the_mean_of_each_stop_in_order():
    columns = fits(methods=("along_beam",))
    drawn = figures.error_along_lane(columns, 0.03).data[0]
    means = [
        1000 * columns["error_3d_m"][columns["stop"] == f"lane3-stop{i}"].mean()
        for i in range(1, 8)
    ]
    assert list(drawn.x) == [1, 2, 3, 4, 5, 6, 7]
    assert_allclose(drawn.y, means, atol=MM)


def test_each_lane_is_a_line_of_its_own():
    columns = fits(14, methods=("along_beam",))
    columns["stop"] = np.array([f"lane{i // 7}-stop{i % 7}" for i in range(14)], dtype=object)
    assert len(figures.error_along_lane(columns, 0.03).data) == 2


def test_names_of_lanes_stand_before_their_first_stops_and_clear_of_each_other():
    columns = fits(35, methods=("along_beam", "paper"))
    columns["stop"] = np.array([f"lane{i % 5}-stop{1 + i // 5 % 7}" for i in range(70)], object)
    figure = figures.error_along_lane(columns, 0.03)
    names = [note for note in figure.layout.annotations if note.text.startswith("lane")]
    assert sorted(note.text for note in names) == sorted(2 * [f"lane{i}" for i in range(5)])
    largest = 1000 * columns["error_3d_m"].max()
    assert np.diff(sorted(note.y for note in names)).min() > 0.049 * largest
    assert figure.layout.xaxis.range[0] < 1


def test_values_are_moved_apart_as_little_as_it_takes():
    assert_allclose(figures.apart(np.array([5.0, 1.0, 1.2, 9.0]), 1.0), [5.0, 0.6, 1.6, 9.0])


@pytest.mark.parametrize(
    ("stop", "lane", "number"),
    [("lane3-stop5", "lane3", 5), ("A 12", "A", 12), ("stop7", "lane", 7), ("gate", "gate", None)],
)
def test_lanes_and_numbers_are_read_from_names(stop, lane, number):
    assert lane_and_number(stop) == (lane, number)


def test_the_map_has_equal_axes_and_names_its_scale_factor():
    figure = solution_map(marks(), stations())
    factor = maps.ellipse_factor(marks(), stations())
    assert figure.layout.yaxis.scaleanchor == "x"
    assert figure.layout.yaxis.scaleratio == 1
    assert figure.layout.xaxis.title.text == "x [m]"
    assert any(f"{factor:g}" in note.text for note in figure.layout.annotations)


def test_ellipses_are_enlarged_by_one_two_or_five_times_a_power_of_ten():
    factor = maps.ellipse_factor(marks(), fixes())
    assert factor / 10 ** np.floor(np.log10(factor)) in (1.0, 2.0, 5.0)
    assert 0.02 < factor * 0.004 / 16.0 <= 0.08


def test_an_ellipse_points_along_its_bearing_from_y_to_x():
    outline = maps.ellipse_outline(fixes(), 0, 100.0) - [-4.0, 0.0]
    assert_allclose(np.abs(outline[:, 0]).max(), 0.4, atol=1e-12)
    assert_allclose(np.abs(outline[:, 1]).max(), 0.2, atol=1e-3)


def test_the_line_of_a_station_leads_to_its_true_place_enlarged_alike():
    figure = solution_map(marks(), stations(error_x_m=[-0.003], error_y_m=[-0.001]))
    factor = maps.ellipse_factor(marks(), stations())
    line = figure.data[-1]
    assert_allclose([line.x[1], line.y[1]], [-4.0 + factor * 0.003, factor * 0.001], atol=1e-9)


def test_without_truth_no_line_leaves_a_station():
    traces = [len(solution_map(marks(), stations(error_x_m=[x])).data) for x in (0.001, np.nan)]
    assert traces[0] == traces[1] + 1


def test_the_bar_of_a_height_is_its_interval_of_95_percent():
    figure = heights(stations(3, error_z_m=[0.002, -0.001, 0.0]))
    assert_allclose(figure.data[0].error_y.array, [1.96] * 3, atol=0.01)
    assert_allclose(trace(figure, "error against truth").y, [2.0, -1.0, 0.0], atol=1e-9)
    assert list(figure.layout.xaxis.ticktext) == ["1", "2", "3"]


def test_every_residual_of_a_station_stands_beside_its_sigma():
    observed = {
        "marker": np.array(["M01", "M02"], dtype=object),
        "mark": np.array(["P07", None], dtype=object),
        **{f"residual_{axis}_m": np.array([0.001, -0.002]) for axis in "xyz"},
        **{f"sigma_{axis}_m": np.array([0.0005, 0.002]) for axis in "xyz"},
    }
    figure = figures.station_residuals(observed, 0.03)
    bars = [one for one in figure.data if one.error_y.array is not None]
    assert len(bars) == 3
    assert_allclose(bars[0].error_y.array, [1.0, 4.0], atol=MM)
    assert list(figure.data[1].x) == ["P07", "M02"]
    assert figure.layout.yaxis.title.text == "Observed - computed [mm]"


def test_empty_tables_give_empty_figures():
    columns = {name: column[:0] for name, column in fits().items()}
    assert not figures.error_against_distance(columns, 0.03).data
    assert not figures.error_along_lane(columns, 0.03).data


def test_a_method_has_one_style_in_every_figure():
    style = theme.method_style("along_beam")
    drawn = [
        figures.error_against_distance(fits(), 0.03).data[0],
        figures.error_along_lane(fits(), 0.03).data[0],
    ]
    assert {one.marker.color for one in drawn} == {style.colour}


def test_no_two_methods_share_a_style():
    styles = [theme.method_style(method) for method in FITTING_METHODS]
    assert len({style.colour for style in styles}) == len(styles)
    assert len({style.symbol for style in styles}) == len(styles)


def test_an_unknown_method_has_another_style():
    style = theme.method_style("other_method")
    assert style.label == "other method"
    assert style.colour not in (theme.OURS, theme.PAPER)


def test_every_colour_has_a_value_for_light_and_for_dark():
    light, dark = (static_folder() / "tokens.css").read_text().split('[data-theme="dark"]')
    names = {value for value in vars(theme).values() if str(value).startswith("var(")}
    names |= {colour for _, colour in (*theme.DIVERGING, *theme.HEIGHTS)} | {*theme.AXES.values()}
    for name in names:
        variable = str(name)[4:-1]
        assert f"{variable}:" in light
        assert f"{variable}:" in dark


def test_the_studys_own_table_lies_over_errors_and_not_over_sigmas():
    for figure, x in (
        (figures.error_against_distance(fits(), 0.03), TABLE_2.ranges),
        (figures.error_against_count(fits(), 0.03), TABLE_2.n_points),
    ):
        (overlay,) = [one for one in figure.data if one.name == "study, Table 2"]
        assert_allclose(overlay.y, TABLE_2.errors_3d * 1e3, rtol=0, atol=MM)
        assert_allclose(overlay.x, x, rtol=0, atol=MM)
    predicted = figures.error_against_distance(fits(with_errors=False), 0.03)
    assert "study, Table 2" not in [one.name for one in predicted.data]
