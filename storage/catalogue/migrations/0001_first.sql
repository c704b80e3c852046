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
COMMENT ON COLUMN surveys.survey_id IS 'Given by the catalogue; the same in every table.';
COMMENT ON COLUMN surveys.name IS 'Given by people, unique.';
COMMENT ON COLUMN surveys.tolerance_m IS '3-D error that the survey accepts.';
COMMENT ON COLUMN surveys.created_at IS 'When it was made (UTC).';

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
COMMENT ON COLUMN control_marks.mark IS 'What the surveyor calls it.';
COMMENT ON COLUMN control_marks.place IS 'Its place in the file, from 0.';
COMMENT ON COLUMN control_marks.x_m IS 'Centre of the sphere in the site frame.';
COMMENT ON COLUMN control_marks.y_m IS 'Centre of the sphere in the site frame.';
COMMENT ON COLUMN control_marks.z_m IS 'Centre of the sphere in the site frame, up.';
COMMENT ON COLUMN control_marks.sigma_x_m IS 'Standard deviation of x; 0 where it is taken as exact.';
COMMENT ON COLUMN control_marks.sigma_y_m IS 'Standard deviation of y; 0 where it is taken as exact.';
COMMENT ON COLUMN control_marks.sigma_z_m IS 'Standard deviation of z; 0 where it is taken as exact.';

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
COMMENT ON COLUMN true_marks.mark IS 'What the simulator calls it.';
COMMENT ON COLUMN true_marks.place IS 'Its place in the file, from 0.';

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
COMMENT ON COLUMN true_stops.stop IS 'Name of the stop, as in the tables of results.';
COMMENT ON COLUMN true_stops.yaw_deg IS 'Heading in R_site_base = Rz(yaw) Ry(pitch) Rx(roll), counter-clockwise from x.';
COMMENT ON COLUMN true_stops.pitch_deg IS 'Rotation about y in the same product.';
COMMENT ON COLUMN true_stops.roll_deg IS 'Rotation about x in the same product.';

CREATE TABLE true_worlds (
    survey_id VARCHAR PRIMARY KEY,
    rig JSON,
    about JSON NOT NULL
);
COMMENT ON TABLE true_worlds IS 'What else is known of a simulated world: its rig, seed and scenario; for comparison only, never an input of a job.';
COMMENT ON COLUMN true_worlds.rig IS 'The true rig, NULL when unknown.';
COMMENT ON COLUMN true_worlds.about IS 'Seed, scenario and the like.';

CREATE TABLE rigs (
    rig_digest VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    rig JSON NOT NULL
);
COMMENT ON TABLE rigs IS 'Every rig that a run used, as JSON.';
COMMENT ON COLUMN rigs.rig_digest IS 'First 16 hexadecimal digits of the SHA-256 of the canonical rig.';
COMMENT ON COLUMN rigs.rig IS 'Mounting, laser table and offsets, with units in the keys.';

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
COMMENT ON COLUMN recordings.recording_id IS 'SHA-256 of the bytes of the log.';
COMMENT ON COLUMN recordings.name IS 'Stem of the name of the uploaded file.';
COMMENT ON COLUMN recordings.size_bytes IS 'Length of the file.';
COMMENT ON COLUMN recordings.uploaded_at IS 'When it came (UTC).';
COMMENT ON COLUMN recordings.url IS 'Where the bytes are.';
COMMENT ON COLUMN recordings.verdict IS 'ok, weak or refused.';
COMMENT ON COLUMN recordings.preflight IS 'The whole preflight report.';

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
COMMENT ON COLUMN jobs.kind IS 'What is done, for instance process.';
COMMENT ON COLUMN jobs.config IS 'The effective configuration.';
COMMENT ON COLUMN jobs.status IS 'accepted, running, successful, failed or dismissed.';
COMMENT ON COLUMN jobs.progress_percent IS '0 to 100, as of this snapshot.';
COMMENT ON COLUMN jobs.message IS 'What was being done last, for people.';
COMMENT ON COLUMN jobs.attempts IS 'How often it was started.';
COMMENT ON COLUMN jobs.created_at IS 'When it was asked for (UTC).';
COMMENT ON COLUMN jobs.started_at IS 'When its last attempt began (UTC).';
COMMENT ON COLUMN jobs.finished_at IS 'When it came to its end (UTC).';
COMMENT ON COLUMN jobs.error_code IS 'Stable code of the error, for programs.';
COMMENT ON COLUMN jobs.error_reason IS 'Why it failed, for people.';
COMMENT ON COLUMN jobs.error_traceback IS 'Where in the code it failed.';

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
COMMENT ON COLUMN runs.run_id IS 'The same in every table of results.';
COMMENT ON COLUMN runs.config IS 'The effective configuration.';
COMMENT ON COLUMN runs.config_digest IS 'First 16 hexadecimal digits of the SHA-256 of the canonical configuration.';
COMMENT ON COLUMN runs.code_version IS 'Version of spheremark.';
COMMENT ON COLUMN runs.finished_at IS 'When the numbers were there (UTC).';
COMMENT ON COLUMN runs.duration_s IS 'Time from the log to the numbers.';
COMMENT ON COLUMN runs.peak_memory_bytes IS 'Largest resident size of the process that made it.';

CREATE TABLE stops (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    n_returns BIGINT NOT NULL,
    coverage_deg DOUBLE NOT NULL,
    duration_s DOUBLE NOT NULL,
    roll_deg DOUBLE NOT NULL,
    pitch_deg DOUBLE NOT NULL,
    sigma_levelling_deg DOUBLE NOT NULL,
    sigma_heading_deg DOUBLE NOT NULL,
    cloud_url VARCHAR,
    notes VARCHAR[] NOT NULL,
    timings_s JSON NOT NULL,
    PRIMARY KEY (run_id, stop)
);
COMMENT ON TABLE stops IS 'One full scan of a run: how it was made and what weakens it.';
COMMENT ON COLUMN stops.stop IS 'Name of the stop: that of the log, numbered when the log holds several.';
COMMENT ON COLUMN stops.n_returns IS 'Returns that were stitched.';
COMMENT ON COLUMN stops.coverage_deg IS 'Angle that the gimbal turned through, at most 360.';
COMMENT ON COLUMN stops.duration_s IS 'Time from the first shot to the last.';
COMMENT ON COLUMN stops.roll_deg IS 'Lean of the base in R_station_base = Ry(pitch) Rx(roll).';
COMMENT ON COLUMN stops.pitch_deg IS 'Lean of the base in R_station_base = Ry(pitch) Rx(roll).';
COMMENT ON COLUMN stops.sigma_heading_deg IS 'Standard deviation of the heading that mounting and encoder leave unknown; it turns all centres of the stop together and is part of their covariances.';
COMMENT ON COLUMN stops.sigma_levelling_deg IS 'Standard deviation of roll and of pitch.';
COMMENT ON COLUMN stops.cloud_url IS 'Where the thinned cloud is; NULL when it was not kept.';
COMMENT ON COLUMN stops.notes IS 'What weakens the results, for people.';
COMMENT ON COLUMN stops.timings_s IS 'Time that each step took.';

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
    incidence_deg DOUBLE,
    variant VARCHAR,
    error_x_m DOUBLE,
    error_y_m DOUBLE,
    error_z_m DOUBLE,
    error_radial_m DOUBLE,
    error_3d_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, marker)
);
COMMENT ON TABLE marker_fits IS 'Sphere centres in the station frame, one row per stop, marker and fitting method; covariances without levelling.';
COMMENT ON COLUMN marker_fits.fit_method IS 'along_beam or silhouette (ours), astm_e3125, free_radius, algebraic, or paper (the study).';
COMMENT ON COLUMN marker_fits.marker IS 'M01, M02 ... by azimuth, within one stop and method.';
COMMENT ON COLUMN marker_fits.mark IS 'Control mark that it was matched to by the first resection method; NULL when to none.';
COMMENT ON COLUMN marker_fits.status IS 'ok or weak.';
COMMENT ON COLUMN marker_fits.reason IS 'Why it is weak; empty when it is not.';
COMMENT ON COLUMN marker_fits.x_m IS 'Centre in the station frame.';
COMMENT ON COLUMN marker_fits.y_m IS 'Centre in the station frame.';
COMMENT ON COLUMN marker_fits.z_m IS 'Centre in the station frame, up.';
COMMENT ON COLUMN marker_fits.cov_xx_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.cov_xy_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.cov_xz_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.cov_yy_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.cov_yz_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.cov_zz_m2 IS 'Covariance of the centre in the station frame, without levelling.';
COMMENT ON COLUMN marker_fits.sigma_3d_m IS 'Square root of the trace of the covariance, heading included.';
COMMENT ON COLUMN marker_fits.range_m IS 'From the mean beam origin to the centre.';
COMMENT ON COLUMN marker_fits.azimuth_deg IS 'Direction to the centre in the station frame, counter-clockwise from x.';
COMMENT ON COLUMN marker_fits.elevation_deg IS 'Direction to the centre above the horizon of the station.';
COMMENT ON COLUMN marker_fits.n_points IS 'Returns that carry the estimate.';
COMMENT ON COLUMN marker_fits.n_rejected IS 'Returns of the candidate that were set aside.';
COMMENT ON COLUMN marker_fits.n_rings IS 'Different lasers among the used returns; 0 when the log does not tell them.';
COMMENT ON COLUMN marker_fits.coverage IS 'Share of the visible half of the sphere that has returns, 0 to 1.';
COMMENT ON COLUMN marker_fits.incidence_deg IS 'Mean angle between the used beams and the normals of the sphere.';
COMMENT ON COLUMN marker_fits.variant IS 'Which form of its method ran, where it has several; else empty.';
COMMENT ON COLUMN marker_fits.rms_m IS 'Root mean square of the residuals (observed minus computed along the beam).';
COMMENT ON COLUMN marker_fits.sigma0 IS 'Square root of the variance factor; 1 means noise as assumed.';
COMMENT ON COLUMN marker_fits.radius_m IS 'Radius that was assumed.';
COMMENT ON COLUMN marker_fits.radius_free_m IS 'Radius when estimated together with the centre; NULL when the returns do not tell.';
COMMENT ON COLUMN marker_fits.sigma_radius_free_m IS 'Standard deviation of radius_free_m.';
COMMENT ON COLUMN marker_fits.mean_intensity IS 'Mean reflectivity of the used returns, 0 to 255.';
COMMENT ON COLUMN marker_fits.error_x_m IS 'Estimate minus truth along x of the station frame; NULL without truth or for a false marker.';
COMMENT ON COLUMN marker_fits.error_y_m IS 'Estimate minus truth along y of the station frame.';
COMMENT ON COLUMN marker_fits.error_z_m IS 'Estimate minus truth along z of the station frame, up.';
COMMENT ON COLUMN marker_fits.error_radial_m IS 'Estimate minus truth along the line of sight; positive is too far.';
COMMENT ON COLUMN marker_fits.error_3d_m IS 'Length of the error.';

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
COMMENT ON COLUMN rejections.x_m IS 'Where it is, in the station frame.';
COMMENT ON COLUMN rejections.y_m IS 'Where it is, in the station frame.';
COMMENT ON COLUMN rejections.z_m IS 'Where it is, in the station frame.';
COMMENT ON COLUMN rejections.n_points IS 'Number of its returns.';
COMMENT ON COLUMN rejections.reason IS 'Why it is not used, for people.';

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
COMMENT ON COLUMN station_fixes.resection_method IS 'How the station was positioned from its markers.';
COMMENT ON COLUMN station_fixes.status IS 'ok, weak or failed.';
COMMENT ON COLUMN station_fixes.reason IS 'Why it is weak or failed; empty when it is ok.';
COMMENT ON COLUMN station_fixes.x_m IS 'Position of the station in the site frame; NULL when failed.';
COMMENT ON COLUMN station_fixes.y_m IS 'Position of the station in the site frame.';
COMMENT ON COLUMN station_fixes.z_m IS 'Position of the station in the site frame, up.';
COMMENT ON COLUMN station_fixes.yaw_deg IS 'Heading of the x axis of the station in the site frame, counter-clockwise from x.';
COMMENT ON COLUMN station_fixes.rotation IS 'R_site_station, nine numbers, rows first.';
COMMENT ON COLUMN station_fixes.cov_xx_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_xy_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_xz_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_yy_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_yz_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_zz_m2 IS 'Covariance of the position in the site frame.';
COMMENT ON COLUMN station_fixes.cov_motion IS 'Covariance of a small motion on the left (rotation in rad, translation in m, site frame), 36 numbers, rows first.';
COMMENT ON COLUMN station_fixes.sigma_3d_m IS 'Square root of the trace of the covariance of the position.';
COMMENT ON COLUMN station_fixes.sigma_yaw_deg IS 'Standard deviation of the heading.';
COMMENT ON COLUMN station_fixes.ellipse_major_m IS 'Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).';
COMMENT ON COLUMN station_fixes.ellipse_minor_m IS 'Semi-minor axis of the horizontal standard ellipse.';
COMMENT ON COLUMN station_fixes.ellipse_bearing_deg IS 'Bearing of the major axis, clockwise from y of the site frame, 0 to 180.';
COMMENT ON COLUMN station_fixes.ellipse_major_95_m IS 'Semi-major axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN station_fixes.ellipse_minor_95_m IS 'Semi-minor axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN station_fixes.n_markers IS 'Markers that carry the fix.';
COMMENT ON COLUMN station_fixes.dof IS 'Observations, gravity included, minus unknowns.';
COMMENT ON COLUMN station_fixes.sigma0 IS 'Square root of the variance factor; NULL without redundancy.';
COMMENT ON COLUMN station_fixes.passes_global_test IS 'Whether the variance factor agrees with 1; true without redundancy.';
COMMENT ON COLUMN station_fixes.included_angle_min_deg IS 'Smallest 3-D angle at the station between two used marks.';
COMMENT ON COLUMN station_fixes.included_angle_max_deg IS 'Largest 3-D angle at the station between two used marks.';
COMMENT ON COLUMN station_fixes.error_x_m IS 'Estimate minus truth along x of the site frame; NULL without truth.';
COMMENT ON COLUMN station_fixes.error_y_m IS 'Estimate minus truth along y of the site frame.';
COMMENT ON COLUMN station_fixes.error_z_m IS 'Estimate minus truth along z of the site frame, up.';
COMMENT ON COLUMN station_fixes.error_yaw_deg IS 'Estimate minus truth of the heading.';
COMMENT ON COLUMN station_fixes.error_horizontal_m IS 'Length of the horizontal error.';
COMMENT ON COLUMN station_fixes.error_3d_m IS 'Length of the error.';

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
COMMENT ON COLUMN observations.used IS 'Whether the marker carries the fix.';
COMMENT ON COLUMN observations.reason IS 'Why it does not; empty when it does.';
COMMENT ON COLUMN observations.residual_x_m IS 'Observed minus computed along x of the site frame; NULL when not used.';
COMMENT ON COLUMN observations.residual_y_m IS 'Observed minus computed along y of the site frame.';
COMMENT ON COLUMN observations.residual_z_m IS 'Observed minus computed along z of the site frame.';
COMMENT ON COLUMN observations.redundancy IS 'Redundancy of its three coordinates together, 0 to 3.';
COMMENT ON COLUMN observations.w IS 'Largest w-statistic of its coordinates; NULL where not testable.';
COMMENT ON COLUMN observations.minimal_detectable_bias_m IS 'Smallest bias that the w-test would find with the power of the configuration; NULL where none is.';
COMMENT ON COLUMN observations.external_reliability_m IS 'Shift of the station by a bias of that size, unseen; NULL where none is found.';

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
COMMENT ON COLUMN resections.marks IS 'The control marks that were used.';
COMMENT ON COLUMN resections.n_marks IS 'How many; 2 for pairs.';
COMMENT ON COLUMN resections.included_angle_deg IS '3-D angle at the station between the two centres.';
COMMENT ON COLUMN resections.included_angle_horizontal_deg IS 'The same in the levelled plane.';
COMMENT ON COLUMN resections.sigma_3d_m IS 'Square root of the trace of the covariance of the position.';
COMMENT ON COLUMN resections.x_m IS 'Position of the station in the site frame.';
COMMENT ON COLUMN resections.y_m IS 'Position of the station in the site frame.';
COMMENT ON COLUMN resections.z_m IS 'Position of the station in the site frame, up.';
COMMENT ON COLUMN resections.error_3d_m IS 'Length of estimate minus truth; NULL without truth.';

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
COMMENT ON COLUMN calibrations.rig_digest IS 'The resulting rig.';
COMMENT ON COLUMN calibrations.parameters IS 'Names of the parameters, in SI units.';
COMMENT ON COLUMN calibrations.covariance IS 'Their covariance, rows in the order of parameters.';

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
COMMENT ON COLUMN adjustments.dof IS 'Observations minus unknowns.';
COMMENT ON COLUMN adjustments.sigma0 IS 'Square root of the variance factor.';
COMMENT ON COLUMN adjustments.passes_global_test IS 'Whether the variance factor agrees with 1.';

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
COMMENT ON COLUMN placements.model_version IS 'Version of the accuracy model.';
COMMENT ON COLUMN placements.sigma_3d_m IS 'Predicted: square root of the trace of the covariance of the position.';
COMMENT ON COLUMN placements.probability_within_tolerance IS 'Predicted probability that the 3-D error is within the tolerance, 0 to 1.';
COMMENT ON COLUMN placements.error_3d_m IS 'Achieved error of the station, once surveyed.';

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
COMMENT ON COLUMN accuracy_by_distance.range_from_m IS 'Lower end of the bin, included.';
COMMENT ON COLUMN accuracy_by_distance.range_to_m IS 'Upper end of the bin, excluded.';
COMMENT ON COLUMN accuracy_by_distance.n_fits IS 'Fits in the bin.';
COMMENT ON COLUMN accuracy_by_distance.mean_n_points IS 'Mean number of returns of a fit.';
COMMENT ON COLUMN accuracy_by_distance.error_radial_mean_m IS 'Mean error along the line of sight; positive is too far.';
COMMENT ON COLUMN accuracy_by_distance.n_errors IS 'Fits whose error is known.';
COMMENT ON COLUMN accuracy_by_distance.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_mean_m IS 'Mean error; the study publishes this one.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_rms_m IS 'Root mean square error.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_p95_m IS '95th percentile of the error; the tolerance holds when it is at most that.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_max_m IS 'Largest error.';

CREATE VIEW accuracy_by_point_count AS
SELECT survey_id, survey, fit_method, 20 * (n_points // 20) AS n_points_from,
    20 * (n_points // 20) + 20 AS n_points_to,
    count(*) AS n_fits, count(error_3d_m) AS n_errors,
    avg(range_m) AS mean_range_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m,
    avg(error_3d_m) AS error_3d_mean_m, sqrt(avg(error_3d_m ^ 2)) AS error_3d_rms_m,
    quantile_cont(error_3d_m, 0.95) AS error_3d_p95_m, max(error_3d_m) AS error_3d_max_m
FROM latest_marker_fits GROUP BY ALL ORDER BY ALL;
COMMENT ON VIEW accuracy_by_point_count IS 'Errors of sphere centres in bins of 20 returns, newest runs.';
COMMENT ON COLUMN accuracy_by_point_count.n_points_from IS 'Lower end of the bin, included.';
COMMENT ON COLUMN accuracy_by_point_count.n_points_to IS 'Upper end of the bin, excluded.';
COMMENT ON COLUMN accuracy_by_point_count.n_fits IS 'Fits in the bin.';
COMMENT ON COLUMN accuracy_by_point_count.mean_range_m IS 'Mean distance of the fits.';
COMMENT ON COLUMN accuracy_by_point_count.n_errors IS 'Fits whose error is known.';
COMMENT ON COLUMN accuracy_by_point_count.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_mean_m IS 'Mean error; the study publishes this one.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_rms_m IS 'Root mean square error.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_p95_m IS '95th percentile of the error; the tolerance holds when it is at most that.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_max_m IS 'Largest error.';

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
COMMENT ON COLUMN accuracy_by_included_angle.n_marks IS 'Marks per position; 2 for pairs.';
COMMENT ON COLUMN accuracy_by_included_angle.included_angle_from_deg IS 'Lower end of the bin, included.';
COMMENT ON COLUMN accuracy_by_included_angle.included_angle_to_deg IS 'Upper end of the bin, excluded.';
COMMENT ON COLUMN accuracy_by_included_angle.n_resections IS 'Positions in the bin.';
COMMENT ON COLUMN accuracy_by_included_angle.n_errors IS 'Positions whose error is known.';
COMMENT ON COLUMN accuracy_by_included_angle.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_included_angle.error_3d_mean_m IS 'Mean error; the study publishes this one.';
COMMENT ON COLUMN accuracy_by_included_angle.error_3d_rms_m IS 'Root mean square error.';
COMMENT ON COLUMN accuracy_by_included_angle.error_3d_p95_m IS '95th percentile of the error; the tolerance holds when it is at most that.';
COMMENT ON COLUMN accuracy_by_included_angle.error_3d_max_m IS 'Largest error.';

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
COMMENT ON COLUMN accuracy_by_stop.n_fits IS 'Markers of the stop.';
COMMENT ON COLUMN accuracy_by_stop.mean_range_m IS 'Mean distance of its markers.';
COMMENT ON COLUMN accuracy_by_stop.marker_error_3d_mean_m IS 'Mean error of its sphere centres.';
COMMENT ON COLUMN accuracy_by_stop.marker_error_3d_max_m IS 'Largest error of its sphere centres.';
COMMENT ON COLUMN accuracy_by_stop.marker_sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m of its centres.';
COMMENT ON COLUMN accuracy_by_stop.status IS 'Status of the station: ok, weak or failed.';
COMMENT ON COLUMN accuracy_by_stop.n_markers IS 'Markers that carry the station.';
COMMENT ON COLUMN accuracy_by_stop.station_sigma_3d_m IS 'Predicted error of the station.';
COMMENT ON COLUMN accuracy_by_stop.station_error_3d_m IS 'Error of the station.';
