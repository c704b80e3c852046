-- The database is a public interface: units are in the names of columns, an unknown value is NULL,
-- nothing is overwritten (a new run is a new set of rows). Lengths in metres, angles in degrees,
-- instants in UTC. error_* columns exist only against truth; sigma_* are predictions; residuals are
-- observed minus computed. Coordinates are in the station frame unless a comment says otherwise.

CREATE TABLE surveys (
    survey_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL UNIQUE,
    tolerance_m DOUBLE NOT NULL,
    created_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE surveys IS 'A field with its control marks and the logs that were recorded there.';

CREATE TABLE control_marks (
    survey_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    place INTEGER NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    sigma_x_m DOUBLE NOT NULL,
    sigma_y_m DOUBLE NOT NULL,
    sigma_z_m DOUBLE NOT NULL,
    PRIMARY KEY (survey_id, mark)
);
COMMENT ON TABLE control_marks IS 'Known sphere centres in the site frame.';

CREATE TABLE true_marks (
    survey_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    place INTEGER NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    PRIMARY KEY (survey_id, mark)
);
COMMENT ON TABLE true_marks IS 'True sphere centres in the site frame; for comparison only, never an input of a job.';

CREATE TABLE true_stops (
    survey_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    yaw_deg DOUBLE NOT NULL,
    pitch_deg DOUBLE NOT NULL,
    roll_deg DOUBLE NOT NULL,
    PRIMARY KEY (survey_id, stop)
);
COMMENT ON TABLE true_stops IS 'True poses of the base frame in the site frame; for comparison only, never an input of a job.';

CREATE TABLE true_worlds (
    survey_id VARCHAR PRIMARY KEY,
    rig JSON,
    about JSON NOT NULL
);
COMMENT ON TABLE true_worlds IS 'What else is known of a simulated world: its rig, seed and scenario; for comparison only, never an input of a job.';

CREATE TABLE rigs (
    rig_digest VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    rig JSON NOT NULL
);
COMMENT ON TABLE rigs IS 'Every rig that a run used, as JSON.';

CREATE TABLE recordings (
    recording_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    size_bytes BIGINT NOT NULL,
    uploaded_at TIMESTAMPTZ NOT NULL,
    url VARCHAR NOT NULL,
    verdict VARCHAR NOT NULL,
    preflight JSON NOT NULL
);
COMMENT ON TABLE recordings IS 'Uploaded logs; recording_id is the SHA-256 of the bytes, verdict is ok, weak or refused, preflight says why.';

CREATE TABLE jobs (
    job_id VARCHAR PRIMARY KEY,
    kind VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR,
    config JSON NOT NULL,
    status VARCHAR NOT NULL,
    progress_percent DOUBLE NOT NULL,
    message VARCHAR NOT NULL,
    attempts INTEGER NOT NULL,
    created_at TIMESTAMPTZ NOT NULL,
    started_at TIMESTAMPTZ,
    finished_at TIMESTAMPTZ,
    error_code VARCHAR,
    error_reason VARCHAR,
    error_traceback VARCHAR
);
COMMENT ON TABLE jobs IS 'Work asked for; status is accepted, running, successful, failed or dismissed.';

CREATE TABLE runs (
    run_id VARCHAR PRIMARY KEY,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    config JSON NOT NULL,
    config_digest VARCHAR NOT NULL,
    code_version VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    duration_s DOUBLE NOT NULL,
    peak_memory_bytes BIGINT
);
COMMENT ON TABLE runs IS 'A recording processed with one configuration by one version of the code.';

CREATE TABLE stops (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    n_returns BIGINT NOT NULL,
    coverage_deg DOUBLE NOT NULL,
    duration_s DOUBLE NOT NULL,
    roll_deg DOUBLE NOT NULL,
    pitch_deg DOUBLE NOT NULL,
    sigma_levelling_deg DOUBLE NOT NULL,
    cloud_url VARCHAR,
    notes VARCHAR[] NOT NULL,
    timings_s JSON NOT NULL,
    PRIMARY KEY (run_id, stop)
);
COMMENT ON TABLE stops IS 'One full scan of a run: how it was made and what weakens it.';

CREATE TABLE marker_fits (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,
    mark VARCHAR,
    status VARCHAR NOT NULL,
    reason VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    cov_xx_m2 DOUBLE,
    cov_xy_m2 DOUBLE,
    cov_xz_m2 DOUBLE,
    cov_yy_m2 DOUBLE,
    cov_yz_m2 DOUBLE,
    cov_zz_m2 DOUBLE,
    sigma_3d_m DOUBLE,
    range_m DOUBLE NOT NULL,
    azimuth_deg DOUBLE NOT NULL,
    elevation_deg DOUBLE NOT NULL,
    n_points INTEGER NOT NULL,
    n_rejected INTEGER NOT NULL,
    n_rings INTEGER NOT NULL,
    coverage DOUBLE,
    rms_m DOUBLE,
    sigma0 DOUBLE,
    radius_m DOUBLE NOT NULL,
    radius_free_m DOUBLE,
    sigma_radius_free_m DOUBLE,
    mean_intensity DOUBLE,
    error_x_m DOUBLE,
    error_y_m DOUBLE,
    error_z_m DOUBLE,
    error_radial_m DOUBLE,
    error_3d_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, marker)
);
COMMENT ON TABLE marker_fits IS 'Sphere centres in the station frame, one row per stop, marker and fitting method; covariances without levelling.';

CREATE TABLE rejections (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    n_points INTEGER NOT NULL,
    reason VARCHAR NOT NULL
);
COMMENT ON TABLE rejections IS 'What looked like a marker at first, and the reason against.';

CREATE TABLE station_fixes (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    status VARCHAR NOT NULL,
    reason VARCHAR NOT NULL,
    x_m DOUBLE,
    y_m DOUBLE,
    z_m DOUBLE,
    yaw_deg DOUBLE,
    rotation DOUBLE[],
    cov_xx_m2 DOUBLE,
    cov_xy_m2 DOUBLE,
    cov_xz_m2 DOUBLE,
    cov_yy_m2 DOUBLE,
    cov_yz_m2 DOUBLE,
    cov_zz_m2 DOUBLE,
    cov_motion DOUBLE[],
    sigma_3d_m DOUBLE,
    sigma_yaw_deg DOUBLE,
    ellipse_major_m DOUBLE,
    ellipse_minor_m DOUBLE,
    ellipse_bearing_deg DOUBLE,
    ellipse_major_95_m DOUBLE,
    ellipse_minor_95_m DOUBLE,
    n_markers INTEGER NOT NULL,
    dof INTEGER,
    sigma0 DOUBLE,
    passes_global_test BOOLEAN,
    included_angle_min_deg DOUBLE,
    included_angle_max_deg DOUBLE,
    error_x_m DOUBLE,
    error_y_m DOUBLE,
    error_z_m DOUBLE,
    error_yaw_deg DOUBLE,
    error_horizontal_m DOUBLE,
    error_3d_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, resection_method)
);
COMMENT ON TABLE station_fixes IS 'Station poses in the site frame, one row per stop, fitting and resection method; status is ok, weak or failed.';

CREATE TABLE observations (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,
    mark VARCHAR,
    used BOOLEAN NOT NULL,
    reason VARCHAR NOT NULL,
    residual_x_m DOUBLE,
    residual_y_m DOUBLE,
    residual_z_m DOUBLE,
    redundancy DOUBLE,
    w DOUBLE,
    minimal_detectable_bias_m DOUBLE,
    external_reliability_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, resection_method, marker)
);
COMMENT ON TABLE observations IS 'One row per marker and fix: residuals in the site frame (observed minus computed), redundancy (of 3) and reliability.';

CREATE TABLE resections (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    marks VARCHAR[] NOT NULL,
    n_marks INTEGER NOT NULL,
    included_angle_deg DOUBLE NOT NULL,
    included_angle_horizontal_deg DOUBLE NOT NULL,
    sigma_3d_m DOUBLE,
    x_m DOUBLE,
    y_m DOUBLE,
    z_m DOUBLE,
    error_3d_m DOUBLE
);
COMMENT ON TABLE resections IS 'The station positioned from each pair of marks alone (with gravity), in the site frame.';

CREATE TABLE calibrations (
    calibration_id VARCHAR PRIMARY KEY,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,
    parameters VARCHAR[] NOT NULL,
    covariance JSON NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE calibrations IS 'Rigs estimated from scans: parameters in SI units, their covariance, and the resulting rig.';

CREATE TABLE adjustments (
    adjustment_id VARCHAR PRIMARY KEY,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    n_stations INTEGER NOT NULL,
    n_marks INTEGER NOT NULL,
    dof INTEGER NOT NULL,
    sigma0 DOUBLE NOT NULL,
    passes_global_test BOOLEAN NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE adjustments IS 'Networks of stations and marks adjusted together.';

CREATE TABLE placements (
    placement_id VARCHAR NOT NULL,
    survey_id VARCHAR,
    model_version VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    n_marks INTEGER NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,
    probability_within_tolerance DOUBLE NOT NULL,
    error_3d_m DOUBLE,
    PRIMARY KEY (placement_id, stop)
);
COMMENT ON TABLE placements IS 'Predicted accuracy per stop of a marker arrangement, and what was achieved once surveyed.';

CREATE VIEW latest_runs AS
SELECT * FROM runs
QUALIFY row_number() OVER (PARTITION BY survey_id, recording_id ORDER BY finished_at DESC) = 1;
COMMENT ON VIEW latest_runs IS 'The newest run of each recording in each survey.';

CREATE VIEW latest_marker_fits AS
SELECT r.survey_id, s.name AS survey, r.recording_id, m.*
FROM marker_fits AS m JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);
COMMENT ON VIEW latest_marker_fits IS 'marker_fits of the newest run of each recording, with the survey.';

CREATE VIEW latest_station_fixes AS
SELECT r.survey_id, s.name AS survey, r.recording_id, f.*
FROM station_fixes AS f JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);
COMMENT ON VIEW latest_station_fixes IS 'station_fixes of the newest run of each recording, with the survey.';

CREATE VIEW accuracy_by_distance AS
SELECT survey_id, survey, fit_method, floor(range_m) AS range_from_m, floor(range_m) + 1 AS range_to_m,
    count(*) AS n_fits, count(error_3d_m) AS n_errors,
    avg(n_points) AS mean_n_points, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m,
    avg(error_3d_m) AS error_3d_mean_m, sqrt(avg(error_3d_m ^ 2)) AS error_3d_rms_m,
    quantile_cont(error_3d_m, 0.95) AS error_3d_p95_m, max(error_3d_m) AS error_3d_max_m,
    avg(error_radial_m) AS error_radial_mean_m
FROM latest_marker_fits GROUP BY ALL ORDER BY ALL;
COMMENT ON VIEW accuracy_by_distance IS 'Errors of sphere centres in bins of 1 m of distance, newest runs.';

CREATE VIEW accuracy_by_point_count AS
SELECT survey_id, survey, fit_method, 20 * (n_points // 20) AS n_points_from,
    20 * (n_points // 20) + 20 AS n_points_to,
    count(*) AS n_fits, count(error_3d_m) AS n_errors,
    avg(range_m) AS mean_range_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m,
    avg(error_3d_m) AS error_3d_mean_m, sqrt(avg(error_3d_m ^ 2)) AS error_3d_rms_m,
    quantile_cont(error_3d_m, 0.95) AS error_3d_p95_m, max(error_3d_m) AS error_3d_max_m
FROM latest_marker_fits GROUP BY ALL ORDER BY ALL;
COMMENT ON VIEW accuracy_by_point_count IS 'Errors of sphere centres in bins of 20 returns, newest runs.';

CREATE VIEW accuracy_by_included_angle AS
SELECT r.survey_id, s.name AS survey, x.fit_method, x.resection_method, x.n_marks,
    10 * floor(x.included_angle_deg / 10) AS included_angle_from_deg,
    10 * floor(x.included_angle_deg / 10) + 10 AS included_angle_to_deg,
    count(*) AS n_resections, count(x.error_3d_m) AS n_errors,
    sqrt(avg(x.sigma_3d_m ^ 2)) AS sigma_3d_rms_m,
    avg(x.error_3d_m) AS error_3d_mean_m, sqrt(avg(x.error_3d_m ^ 2)) AS error_3d_rms_m,
    quantile_cont(x.error_3d_m, 0.95) AS error_3d_p95_m, max(x.error_3d_m) AS error_3d_max_m
FROM resections AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
GROUP BY ALL ORDER BY ALL;
COMMENT ON VIEW accuracy_by_included_angle IS 'Errors of stations positioned from pairs of marks in bins of 10 degrees of included angle, newest runs.';

CREATE VIEW accuracy_by_stop AS
SELECT m.survey_id, m.survey, m.stop, m.fit_method, m.n_fits, m.mean_range_m,
    m.error_3d_mean_m AS marker_error_3d_mean_m, m.error_3d_max_m AS marker_error_3d_max_m,
    m.sigma_3d_rms_m AS marker_sigma_3d_rms_m,
    f.resection_method, f.status, f.n_markers, f.sigma_3d_m AS station_sigma_3d_m,
    f.error_3d_m AS station_error_3d_m
FROM (
    SELECT survey_id, survey, recording_id, stop, fit_method, count(*) AS n_fits,
        avg(range_m) AS mean_range_m, avg(error_3d_m) AS error_3d_mean_m,
        max(error_3d_m) AS error_3d_max_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m
    FROM latest_marker_fits GROUP BY ALL
) AS m
LEFT JOIN latest_station_fixes AS f USING (survey_id, recording_id, stop, fit_method)
ORDER BY m.survey, m.stop, m.fit_method;
COMMENT ON VIEW accuracy_by_stop IS 'Mean error of the sphere centres and error of the station per stop, newest runs.';
