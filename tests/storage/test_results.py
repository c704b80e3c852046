import dataclasses
import json

import duckdb
import numpy as np
import pytest

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.scan.rigs import rig_digest, rig_from_mapping
from spheremark.storage.catalogue.migrations import migrate, released
from spheremark.storage.catalogue.results import tables, with_errors
from tests.storage.made_up import (
    LEVELLING,
    MARKS,
    P_SITE,
    SHIFT_BASE,
    SHIFT_SITE,
    R_station_base,
    made_tables,
    run,
    stop,
    truth,
)


def rows(found, table, **wanted):
    every = found[table].to_pylist()
    return [row for row in every if all(row[key] == value for key, value in wanted.items())]


def covariance(row):
    xx, xy, xz, yy, yz, zz = (row[f"cov_{a}_m2"] for a in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def place(row):
    return np.array([row["x_m"], row["y_m"], row["z_m"]])


def test_the_database_takes_every_table():
    connection = duckdb.connect()
    migrate(connection, released())
    for name, table in made_tables(truth("L1S1")).items():
        connection.register("incoming", table)
        connection.execute(f"INSERT INTO {name} BY NAME SELECT * FROM incoming")  # noqa: S608
        count = connection.execute(f"SELECT count(*) FROM {name}").fetchall()  # noqa: S608
        assert count == [(table.num_rows,)]


def test_a_run_has_the_provenance_of_its_numbers():
    found = made_tables()
    (row,) = found["runs"].to_pylist()
    info = run()
    assert row["config"] == info.config.text
    assert row["config_digest"] == info.config.digest
    assert row["finished_at"] == info.finished_at
    assert row["duration_s"] == info.duration
    (rig,) = found["rigs"].to_pylist()
    assert rig["rig_digest"] == row["rig_digest"] == rig_digest(stop().cloud.rig)
    assert rig_digest(rig_from_mapping(json.loads(rig["rig"]))) == row["rig_digest"]


def test_centres_and_covariances_are_those_of_the_levelled_frame():
    R = R_station_base()
    fits = stop().fits["along_beam"].fits
    for i, row in enumerate(rows(made_tables(), "marker_fits", fit_method="along_beam")):
        np.testing.assert_allclose(R.T @ place(row), fits[i].p_base, rtol=0, atol=1e-12)
        back = R.T @ covariance(row) @ R
        cov_base = fits[i].cov_with_heading(stop().sigma_heading)
        np.testing.assert_allclose(back, cov_base, rtol=0, atol=1e-15)
        x, y, z = place(row)
        length = np.linalg.norm([x, y, z])
        azimuth, elevation = np.radians([row["azimuth_deg"], row["elevation_deg"]])
        direction = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth), 0])
        direction[2] = np.sin(elevation)
        np.testing.assert_allclose(length * direction, [x, y, z], rtol=0, atol=1e-9)


def test_markers_are_named_in_order_and_carry_the_mark_that_the_fix_matched():
    found = rows(made_tables(), "marker_fits", fit_method="along_beam")
    assert [row["marker"] for row in found] == [f"M0{i}" for i in range(1, 8)]
    assert [row["mark"] for row in found] == [*MARKS.names[:5], None, None]


def test_a_method_without_a_fix_has_no_marks():
    found = rows(made_tables(), "marker_fits", fit_method="paper")
    assert [row["mark"] for row in found] == [None] * 7


def test_errors_of_centres_are_along_the_axes_of_the_station():
    found = made_tables(truth("L1S1"))
    expected = R_station_base() @ SHIFT_BASE
    *good, false = rows(found, "marker_fits", fit_method="along_beam")
    for row in good:
        error = [row["error_x_m"], row["error_y_m"], row["error_z_m"]]
        np.testing.assert_allclose(error, expected, rtol=0, atol=1e-12)
        assert row["error_3d_m"] == pytest.approx(np.linalg.norm(SHIFT_BASE), abs=1e-12)
        true = place(row) - expected
        assert row["error_radial_m"] == pytest.approx(
            expected @ true / np.linalg.norm(true), abs=1e-12
        )
    assert false["error_3d_m"] is None
    assert false["error_radial_m"] is None


def test_errors_of_the_station_are_along_the_axes_of_the_site():
    found = made_tables(truth("L1S1"))
    (row,) = rows(found, "station_fixes", fit_method="along_beam")
    error = [row["error_x_m"], row["error_y_m"], row["error_z_m"]]
    np.testing.assert_allclose(error, SHIFT_SITE, rtol=0, atol=1e-12)
    assert row["error_horizontal_m"] == pytest.approx(np.hypot(*SHIFT_SITE[:2]), abs=1e-12)
    assert row["error_yaw_deg"] == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("known", [None, truth("another")])
def test_without_the_truth_of_the_stop_no_error_exists(known):
    for table in made_tables(known).values():
        for name in (n for n in table.column_names if n.startswith("error_")):
            assert table.column(name).null_count == table.num_rows


def test_errors_taken_anew_are_those_taken_at_once():
    late = with_errors(made_tables(), truth("L1S1"))
    for name, table in made_tables(truth("L1S1")).items():
        assert late[name].equals(table), name


def test_the_sigma_of_a_centre_has_the_heading_at_its_distance():
    result = stop()
    for row, fit in zip(
        rows(made_tables(), "marker_fits", fit_method="along_beam"),
        result.fits["along_beam"].fits,
        strict=True,
    ):
        sideways = np.hypot(*fit.p_base[:2]) * result.sigma_heading
        assert row["sigma_3d_m"] ** 2 == pytest.approx(np.trace(fit.cov_p_base) + sideways**2)


def test_a_pose_can_be_rebuilt_from_its_row():
    (row,) = rows(made_tables(), "station_fixes", fit_method="along_beam")
    fix = stop().fixes["along_beam", "free_station"]
    rotation = np.array(row["rotation"]).reshape(3, 3)
    np.testing.assert_array_equal(rotation, fix.T_site_station[:3, :3])
    np.testing.assert_array_equal(place(row), fix.p_site)
    motion = np.array(row["cov_motion"]).reshape(6, 6)
    np.testing.assert_array_equal(motion, fix.cov_T_site_station)
    np.testing.assert_allclose(covariance(row), fix.cov_p_site, rtol=0, atol=1e-18)
    assert row["sigma_yaw_deg"] == pytest.approx(np.degrees(np.sqrt(fix.cov_T_site_station[2, 2])))
    assert (row["dof"], row["n_markers"], row["sigma0"]) == (11, 5, None)


def test_the_ellipse_rebuilds_the_horizontal_covariance():
    (row,) = rows(made_tables(), "station_fixes", fit_method="along_beam")
    bearing = np.radians(row["ellipse_bearing_deg"])
    major, minor = row["ellipse_major_m"], row["ellipse_minor_m"]
    along = np.array([np.sin(bearing), np.cos(bearing)])  # clockwise from y
    across = np.array([along[1], -along[0]])
    rebuilt = major**2 * np.outer(along, along) + minor**2 * np.outer(across, across)
    np.testing.assert_allclose(rebuilt, covariance(row)[:2, :2], rtol=1e-9)
    assert 0 <= row["ellipse_bearing_deg"] < 180
    assert row["ellipse_major_95_m"] / major == pytest.approx(2.4477, abs=1e-4)
    assert row["ellipse_minor_95_m"] / minor == pytest.approx(2.4477, abs=1e-4)


def test_a_station_that_failed_is_a_row_with_its_reason_and_no_numbers():
    (row,) = rows(made_tables(truth("L1S1")), "station_fixes", fit_method="paper")
    assert (row["status"], row["reason"], row["n_markers"]) == ("failed", "No match.", 0)
    assert row["x_m"] is None
    assert row["error_3d_m"] is None


def test_every_marker_of_a_fix_has_an_observation_used_or_not():
    found = rows(made_tables(), "observations")
    fix = stop().fixes["along_beam", "free_station"]
    assert len(found) == 7
    assert [row["used"] for row in found] == [True] * 5 + [False] * 2
    assert [row["reason"] for row in found[5:]] == ["Fails the w-test.", "Not matched."]
    assert found[4]["residual_x_m"] == fix.residuals_site[0, 0]
    assert found[4]["w"] == fix.w_statistics[0]
    assert found[0]["w"] is None
    assert found[0]["minimal_detectable_bias_m"] is None
    assert found[0]["external_reliability_m"] is None
    assert all((row["shift_without_m"] is None) == (not row["used"]) for row in found)
    assert all(0.0 < row["shift_without_m"] < 0.05 for row in found[:5])


def test_a_station_has_its_dilution_of_precision():
    found = {row["fit_method"]: row["dop"] for row in rows(made_tables(), "station_fixes")}
    assert 0.5 < found["along_beam"] < 3.0
    assert found["paper"] is None


def test_pairs_and_triples_name_their_marks_and_angles():
    first, second, triple = rows(made_tables(), "resections")
    assert first["marks"] == [MARKS.names[0], MARKS.names[1]]
    assert first["included_angle_deg"] == pytest.approx(32.0)
    assert first["included_angle_max_deg"] == pytest.approx(32.0)
    np.testing.assert_array_equal(place(first), P_SITE + np.array([0.01, 0, 0]))
    assert second["x_m"] is second["sigma_horizontal_m"] is None
    assert triple["marks"] == list(MARKS.names[:3])
    assert [one["n_marks"] for one in (first, second, triple)] == [2, 2, 3]
    assert triple["included_angle_deg"] == pytest.approx(32.0)
    assert triple["included_angle_max_deg"] == pytest.approx(107.0)


def test_errors_of_pairs_and_triples_are_lengths_in_the_plane_and_in_space():
    known = truth("L1S1")
    base = known.stops[0].T_site_base[:3, 3]
    first, second, triple = rows(made_tables(known), "resections")
    for row in (first, triple):
        error = np.array(place(row)) - base
        assert row["error_3d_m"] == pytest.approx(np.sqrt(error @ error))
        assert row["error_horizontal_m"] == pytest.approx(np.sqrt(error[:2] @ error[:2]))
    assert second["error_3d_m"] is None
    elsewhere = rows(made_tables(truth("another")), "resections")
    assert [row["error_3d_m"] for row in elsewhere] == [None] * 3


def test_a_stop_has_its_acquisition():
    found = tables(run(), (stop(),), marks=MARKS, clouds={"L1S1": "/clouds/x.parquet"})
    (row,) = found["stops"].to_pylist()
    assert row["coverage_deg"] == pytest.approx(360.0)
    assert np.radians(row["roll_deg"]) == pytest.approx(LEVELLING.roll)
    assert row["cloud_url"] == "/clouds/x.parquet"
    assert row["notes"] == ["The log has no rings."]
    assert json.loads(row["timings_s"]) == {"stitching": 0.1}
    assert row["n_returns"] == len(stop().cloud.p_base)


def test_no_number_is_nan():
    for table in made_tables(truth("L1S1")).values():
        for row in table.to_pylist():
            numbers = [value for value in row.values() if isinstance(value, float)]
            assert np.isfinite(numbers).all()


def test_rejections_are_kept_with_their_reason():
    found = rows(made_tables(), "rejections", fit_method="along_beam")
    assert [row["reason"] for row in found] == ["A pole."]
    expected = R_station_base() @ [3.0, 0.0, 1.0]
    np.testing.assert_allclose(place(found[0]), expected, rtol=0, atol=1e-12)


def test_a_stop_without_control_has_centres_and_no_fix():
    alone = dataclasses.replace(stop(), fixes={}, subsets={})
    found = tables(run(), (alone,))
    assert found["station_fixes"].num_rows == found["observations"].num_rows == 0
    assert found["marker_fits"].num_rows == 14


def test_fixes_without_their_control_marks_are_refused():
    with pytest.raises(InputError, match="give the control marks"):
        tables(run(), (stop(),))


def test_a_run_without_stops_is_refused():
    with pytest.raises(InputError, match="has no stop"):
        tables(run(), ())
