-- The database is a public interface: units are in the names of columns, an unknown value is NULL,
-- nothing is overwritten (a new run is a new set of rows). Lengths in metres, angles in degrees,
-- instants in UTC. error_* columns exist only against truth; sigma_* are predictions; residuals are
-- observed minus computed. Coordinates are in the station frame unless a comment says otherwise.

-- Surveys, their marks and logs.

CREATE TABLE surveys (
    survey_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL UNIQUE,
    tolerance_m DOUBLE NOT NULL,
    created_at TIMESTAMPTZ NOT NULL,
    rig_digest VARCHAR
);
COMMENT ON TABLE surveys IS 'A field with its control marks and the logs that were recorded there.';
COMMENT ON COLUMN surveys.survey_id IS 'Given by the catalogue; the same in every table.';
COMMENT ON COLUMN surveys.name IS 'Name of the user, unique.';
COMMENT ON COLUMN surveys.tolerance_m IS '3-D error that the survey accepts.';
COMMENT ON COLUMN surveys.created_at IS 'Instant of creation (UTC).';
COMMENT ON COLUMN surveys.rig_digest IS 'Rig that its jobs use where they name none; NULL: the one that each log describes.';

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
COMMENT ON COLUMN control_marks.mark IS 'Name of the mark.';
COMMENT ON COLUMN control_marks.place IS 'Its place in the file, from 0.';
COMMENT ON COLUMN control_marks.x_m IS 'Centre of the sphere in the site frame.';
COMMENT ON COLUMN control_marks.y_m IS 'Centre of the sphere in the site frame.';
COMMENT ON COLUMN control_marks.z_m IS 'Centre of the sphere in the site frame, up.';
COMMENT ON COLUMN control_marks.sigma_x_m IS 'Standard deviation of x; 0 where it is taken as exact.';
COMMENT ON COLUMN control_marks.sigma_y_m IS 'Standard deviation of y; 0 where it is taken as exact.';
COMMENT ON COLUMN control_marks.sigma_z_m IS 'Standard deviation of z; 0 where it is taken as exact.';

CREATE TABLE rigs (
    rig_digest VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    rig JSON NOT NULL
);
COMMENT ON TABLE rigs IS 'Rigs of runs, of calibrations and of users, as JSON.';
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
COMMENT ON COLUMN recordings.uploaded_at IS 'Instant of the upload (UTC).';
COMMENT ON COLUMN recordings.url IS 'Location of the file.';
COMMENT ON COLUMN recordings.verdict IS 'ok, weak or refused.';
COMMENT ON COLUMN recordings.preflight IS 'The whole preflight report.';

CREATE TABLE survey_recordings (
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    PRIMARY KEY (survey_id, recording_id)
);
COMMENT ON TABLE survey_recordings IS 'Logs that were uploaded for a survey; those that its jobs read belong to it too.';

-- Truth, where it is known.

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
COMMENT ON COLUMN true_marks.mark IS 'Name of the mark in the simulator.';
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
COMMENT ON TABLE true_worlds IS 'Rig, seed and scenario of a simulated world; for comparison only, never an input of a job.';
COMMENT ON COLUMN true_worlds.rig IS 'The true rig, NULL when unknown.';
COMMENT ON COLUMN true_worlds.about IS 'Seed, scenario and the like.';

-- Jobs and runs.

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
    error_traceback VARCHAR,
    options JSON DEFAULT '{}'
);
COMMENT ON TABLE jobs IS 'Jobs; status is accepted, running, successful, failed or dismissed.';
COMMENT ON COLUMN jobs.kind IS 'Kind of the job, for instance process.';
COMMENT ON COLUMN jobs.config IS 'The effective configuration.';
COMMENT ON COLUMN jobs.status IS 'accepted, running, successful, failed or dismissed.';
COMMENT ON COLUMN jobs.progress_percent IS '0 to 100, as of this snapshot.';
COMMENT ON COLUMN jobs.message IS 'Last step, as a sentence.';
COMMENT ON COLUMN jobs.attempts IS 'Number of starts.';
COMMENT ON COLUMN jobs.created_at IS 'Instant of the request (UTC).';
COMMENT ON COLUMN jobs.started_at IS 'Start of the last attempt (UTC).';
COMMENT ON COLUMN jobs.finished_at IS 'End of the job (UTC).';
COMMENT ON COLUMN jobs.error_code IS 'Stable code of the error, for programs.';
COMMENT ON COLUMN jobs.error_reason IS 'Reason of the failure, as a sentence.';
COMMENT ON COLUMN jobs.error_traceback IS 'Traceback of the failure.';
COMMENT ON COLUMN jobs.options IS 'Options beside the configuration: rig (a digest), recordings (of a job that reads several), and those of its kind.';

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
COMMENT ON COLUMN runs.finished_at IS 'End of the run (UTC).';
COMMENT ON COLUMN runs.duration_s IS 'Time from the log to the numbers.';
COMMENT ON COLUMN runs.peak_memory_bytes IS 'Largest resident size of the worker process.';

-- Results of a run.

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
COMMENT ON TABLE stops IS 'One full scan of a run: its acquisition and its weaknesses.';
COMMENT ON COLUMN stops.stop IS 'Name of the stop: that of the log, numbered when the log holds several.';
COMMENT ON COLUMN stops.n_returns IS 'Returns that were stitched.';
COMMENT ON COLUMN stops.coverage_deg IS 'Rotation of the gimbal during the scan, at most 360.';
COMMENT ON COLUMN stops.duration_s IS 'Time from the first pulse to the last.';
COMMENT ON COLUMN stops.roll_deg IS 'Rotation of the base in R_station_base = Ry(pitch) Rx(roll).';
COMMENT ON COLUMN stops.pitch_deg IS 'Rotation of the base in R_station_base = Ry(pitch) Rx(roll).';
COMMENT ON COLUMN stops.sigma_levelling_deg IS 'Standard deviation of roll and of pitch.';
COMMENT ON COLUMN stops.sigma_heading_deg IS 'Standard deviation of the heading from mounting and encoder; it rotates all centres of the stop together and is part of their covariances.';
COMMENT ON COLUMN stops.cloud_url IS 'Location of the thinned cloud; NULL without one.';
COMMENT ON COLUMN stops.notes IS 'Weaknesses of the scan, as sentences.';
COMMENT ON COLUMN stops.timings_s IS 'Duration of each step.';

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
    sigma_range_shared_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, marker)
);
COMMENT ON TABLE marker_fits IS 'Sphere centres in the station frame, one row per stop, marker and fitting method; covariances without levelling.';
COMMENT ON COLUMN marker_fits.fit_method IS 'along_beam or silhouette (ours), astm_e3125, free_radius, algebraic, or paper (the study).';
COMMENT ON COLUMN marker_fits.marker IS 'M01, M02 ... by azimuth, within one stop: the same sphere by every method; a method that refused it has no row.';
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
COMMENT ON COLUMN marker_fits.n_points IS 'Returns that the fit used.';
COMMENT ON COLUMN marker_fits.n_rejected IS 'Returns of the candidate that the fit did not use.';
COMMENT ON COLUMN marker_fits.n_rings IS 'Different lasers among the used returns; 0 when the log has no lasers.';
COMMENT ON COLUMN marker_fits.coverage IS 'Share of the visible half of the sphere that has returns, 0 to 1.';
COMMENT ON COLUMN marker_fits.rms_m IS 'Root mean square of the residuals (observed minus computed along the beam).';
COMMENT ON COLUMN marker_fits.sigma0 IS 'Square root of the variance factor; 1 means noise as assumed.';
COMMENT ON COLUMN marker_fits.radius_m IS 'Assumed radius.';
COMMENT ON COLUMN marker_fits.radius_free_m IS 'Radius when estimated together with the centre; NULL when the returns do not determine it.';
COMMENT ON COLUMN marker_fits.sigma_radius_free_m IS 'Standard deviation of radius_free_m.';
COMMENT ON COLUMN marker_fits.mean_intensity IS 'Mean reflectivity of the used returns, 0 to 255.';
COMMENT ON COLUMN marker_fits.incidence_deg IS 'Mean angle between the used beams and the normals of the sphere.';
COMMENT ON COLUMN marker_fits.variant IS 'Which form of its method ran, where it has several; else empty.';
COMMENT ON COLUMN marker_fits.error_x_m IS 'Estimate minus truth along x of the station frame; NULL without truth or for a false marker.';
COMMENT ON COLUMN marker_fits.error_y_m IS 'Estimate minus truth along y of the station frame.';
COMMENT ON COLUMN marker_fits.error_z_m IS 'Estimate minus truth along z of the station frame, up.';
COMMENT ON COLUMN marker_fits.error_radial_m IS 'Estimate minus truth along the line of sight; positive is too far.';
COMMENT ON COLUMN marker_fits.error_3d_m IS 'Length of the error.';
COMMENT ON COLUMN marker_fits.sigma_range_shared_m IS 'Standard deviation of the range error that all centres of the stop share, part of their covariances; NULL where the method gives none.';

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
COMMENT ON TABLE rejections IS 'Candidates that are no markers, with the reason.';
COMMENT ON COLUMN rejections.x_m IS 'Position in the station frame.';
COMMENT ON COLUMN rejections.y_m IS 'Position in the station frame.';
COMMENT ON COLUMN rejections.z_m IS 'Position in the station frame.';
COMMENT ON COLUMN rejections.n_points IS 'Number of its returns.';
COMMENT ON COLUMN rejections.reason IS 'Reason of the rejection, as a sentence.';

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
    dop DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, resection_method)
);
COMMENT ON TABLE station_fixes IS 'Station poses in the site frame, one row per stop, fitting and resection method; status is ok, weak or failed.';
COMMENT ON COLUMN station_fixes.resection_method IS 'Method of positioning from the markers.';
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
COMMENT ON COLUMN station_fixes.n_markers IS 'Markers used for the fix.';
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
COMMENT ON COLUMN station_fixes.dop IS 'Dilution of precision: 3-D sigma of the position, levelled, for observations that all have a sigma of 1; NULL where there is none.';

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
    shift_without_m DOUBLE,
    PRIMARY KEY (run_id, stop, fit_method, resection_method, marker)
);
COMMENT ON TABLE observations IS 'One row per marker and fix: residuals in the site frame (observed minus computed), redundancy (of 3) and reliability.';
COMMENT ON COLUMN observations.used IS 'Whether the fix uses the marker.';
COMMENT ON COLUMN observations.reason IS 'Reason of the omission; empty when it is used.';
COMMENT ON COLUMN observations.residual_x_m IS 'Observed minus computed along x of the site frame; NULL when not used.';
COMMENT ON COLUMN observations.residual_y_m IS 'Observed minus computed along y of the site frame.';
COMMENT ON COLUMN observations.residual_z_m IS 'Observed minus computed along z of the site frame.';
COMMENT ON COLUMN observations.redundancy IS 'Redundancy of its three coordinates together, 0 to 3.';
COMMENT ON COLUMN observations.w IS 'Largest w-statistic of its coordinates; NULL where not testable.';
COMMENT ON COLUMN observations.minimal_detectable_bias_m IS 'Smallest bias that the w-test would find with the power of the configuration; NULL where none is.';
COMMENT ON COLUMN observations.external_reliability_m IS 'Shift of the station by an undetected bias of that size; NULL where none is found.';
COMMENT ON COLUMN observations.shift_without_m IS 'How far the station moves when this marker is left out; NULL for markers that are not used, and for trilateration.';

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
    error_3d_m DOUBLE,
    included_angle_max_deg DOUBLE,
    sigma_horizontal_m DOUBLE,
    error_horizontal_m DOUBLE
);
COMMENT ON TABLE resections IS 'The station positioned from each pair and each triple of marks alone (with gravity), in the site frame, by each resection method.';
COMMENT ON COLUMN resections.marks IS 'The control marks that were used.';
COMMENT ON COLUMN resections.n_marks IS 'How many; 2 for pairs, 3 for triples.';
COMMENT ON COLUMN resections.included_angle_deg IS '3-D angle at the station between the two centres; of three the smallest of the three angles.';
COMMENT ON COLUMN resections.included_angle_horizontal_deg IS 'The smallest angle in the levelled plane.';
COMMENT ON COLUMN resections.sigma_3d_m IS 'Square root of the trace of the covariance of the position.';
COMMENT ON COLUMN resections.x_m IS 'Position of the station in the site frame.';
COMMENT ON COLUMN resections.y_m IS 'Position of the station in the site frame.';
COMMENT ON COLUMN resections.z_m IS 'Position of the station in the site frame, up.';
COMMENT ON COLUMN resections.error_3d_m IS 'Length of estimate minus truth; NULL without truth.';
COMMENT ON COLUMN resections.included_angle_max_deg IS 'The same; of three the largest of the three angles.';
COMMENT ON COLUMN resections.sigma_horizontal_m IS 'Square root of the trace of the covariance of x and y.';
COMMENT ON COLUMN resections.error_horizontal_m IS 'Length of estimate minus truth in the plane; NULL without truth.';

-- Calibrations.

CREATE TABLE calibrations (
    calibration_id VARCHAR PRIMARY KEY,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,
    parameters VARCHAR[] NOT NULL,
    covariance JSON NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    start_rig_digest VARCHAR,
    stops VARCHAR[],
    n_spheres INTEGER,
    n_two_faced INTEGER,
    n_returns BIGINT,
    dof INTEGER,
    sigma0 DOUBLE,
    residual_rms_before_m DOUBLE,
    residual_rms_after_m DOUBLE,
    n_gaps INTEGER,
    gap_rms_before_m DOUBLE,
    gap_rms_after_m DOUBLE,
    gap_sigma_after_m DOUBLE,
    config JSON,
    config_digest VARCHAR,
    code_version VARCHAR,
    duration_s DOUBLE
);
COMMENT ON TABLE calibrations IS 'Rigs estimated from scans: parameters in SI units, their covariance, and the resulting rig.';
COMMENT ON COLUMN calibrations.calibration_id IS 'The same in every table of its results.';
COMMENT ON COLUMN calibrations.rig_digest IS 'The resulting rig.';
COMMENT ON COLUMN calibrations.parameters IS 'Names of the parameters, in SI units.';
COMMENT ON COLUMN calibrations.covariance IS 'Their covariance, rows in the order of parameters.';
COMMENT ON COLUMN calibrations.start_rig_digest IS 'The rig before the calibration.';
COMMENT ON COLUMN calibrations.stops IS 'Names of the stops that were used.';
COMMENT ON COLUMN calibrations.n_spheres IS 'Spheres, counted once per stop.';
COMMENT ON COLUMN calibrations.n_two_faced IS 'Spheres with returns on both faces.';
COMMENT ON COLUMN calibrations.n_returns IS 'Returns of the estimate.';
COMMENT ON COLUMN calibrations.dof IS 'Returns minus unknowns.';
COMMENT ON COLUMN calibrations.sigma0 IS 'Square root of the variance factor; 1 means range noise as usual for a VLP-16.';
COMMENT ON COLUMN calibrations.residual_rms_before_m IS 'Root mean square residual of the returns with the rig before the calibration, the centres adjusted to it.';
COMMENT ON COLUMN calibrations.residual_rms_after_m IS 'The same with the estimated rig.';
COMMENT ON COLUMN calibrations.n_gaps IS 'Spheres whose two faces were compared with the estimated rig.';
COMMENT ON COLUMN calibrations.gap_rms_before_m IS 'Root mean square distance between the centres that the two faces of a sphere give, with the rig before the calibration; NULL where none could be compared.';
COMMENT ON COLUMN calibrations.gap_rms_after_m IS 'The same with the estimated rig.';
COMMENT ON COLUMN calibrations.gap_sigma_after_m IS 'Its prediction from the covariances of the centres.';
COMMENT ON COLUMN calibrations.config IS 'The effective configuration.';
COMMENT ON COLUMN calibrations.config_digest IS 'First 16 hexadecimal digits of the SHA-256 of the canonical configuration.';
COMMENT ON COLUMN calibrations.code_version IS 'Version of spheremark.';
COMMENT ON COLUMN calibrations.duration_s IS 'Time from the logs to the numbers.';

CREATE TABLE calibrated_parameters (
    calibration_id VARCHAR NOT NULL,
    place INTEGER NOT NULL,
    parameter VARCHAR NOT NULL,
    unit VARCHAR NOT NULL,
    is_estimated BOOLEAN NOT NULL,
    start_value DOUBLE,
    estimate DOUBLE,
    sigma DOUBLE,
    reason VARCHAR NOT NULL,
    PRIMARY KEY (calibration_id, parameter)
);
COMMENT ON TABLE calibrated_parameters IS 'Each parameter of a rig before and after a calibration; parameters that the scans do not determine have a reason.';
COMMENT ON COLUMN calibrated_parameters.place IS 'Index in the covariance, from 0; parameters that are not estimated follow.';
COMMENT ON COLUMN calibrated_parameters.unit IS 'Unit of its numbers; empty where it was not estimated.';
COMMENT ON COLUMN calibrated_parameters.is_estimated IS 'Whether the scans determine it.';
COMMENT ON COLUMN calibrated_parameters.start_value IS 'Value before the calibration, in the unit of the row.';
COMMENT ON COLUMN calibrated_parameters.estimate IS 'Value after the calibration, in the unit of the row.';
COMMENT ON COLUMN calibrated_parameters.sigma IS 'Its standard deviation, in the unit of the row.';
COMMENT ON COLUMN calibrated_parameters.reason IS 'Why it was not estimated; empty when it was.';

CREATE TABLE calibration_gaps (
    calibration_id VARCHAR NOT NULL,
    is_after BOOLEAN NOT NULL,
    stop VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,
    range_m DOUBLE NOT NULL,
    azimuth_deg DOUBLE NOT NULL,
    gap_radial_m DOUBLE NOT NULL,
    gap_across_m DOUBLE NOT NULL,
    gap_up_m DOUBLE NOT NULL,
    gap_3d_m DOUBLE NOT NULL,
    sigma_3d_m DOUBLE NOT NULL
);
COMMENT ON TABLE calibration_gaps IS 'Difference of the centre of each sphere from the two faces of a scan, front minus back, in the base frame.';
COMMENT ON COLUMN calibration_gaps.is_after IS 'Whether with the estimated rig, or with the rig before.';
COMMENT ON COLUMN calibration_gaps.marker IS 'M01, M02 ... by azimuth, within one stop and rig.';
COMMENT ON COLUMN calibration_gaps.range_m IS 'From the base to the middle of both centres.';
COMMENT ON COLUMN calibration_gaps.azimuth_deg IS 'Direction to it, counter-clockwise from x.';
COMMENT ON COLUMN calibration_gaps.gap_radial_m IS 'Along the line of sight; positive where the front is farther.';
COMMENT ON COLUMN calibration_gaps.gap_across_m IS 'Horizontally across it, counter-clockwise.';
COMMENT ON COLUMN calibration_gaps.gap_up_m IS 'Across both, up.';
COMMENT ON COLUMN calibration_gaps.gap_3d_m IS 'Length of the gap.';
COMMENT ON COLUMN calibration_gaps.sigma_3d_m IS 'Its prediction from the covariances of both centres.';

-- Adjusted networks.

CREATE TABLE adjustments (
    adjustment_id VARCHAR PRIMARY KEY,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    n_stations INTEGER NOT NULL,
    n_marks INTEGER NOT NULL,
    dof INTEGER NOT NULL,
    sigma0 DOUBLE,
    passes_global_test BOOLEAN NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    status VARCHAR,
    warnings VARCHAR[],
    datum VARCHAR,
    datum_text VARCHAR,
    fit_method VARCHAR,
    n_control_marks INTEGER,
    n_observations INTEGER,
    n_unknowns INTEGER,
    n_left_out INTEGER,
    n_refused INTEGER,
    vtpv DOUBLE,
    vtpv_limit DOUBLE,
    test_level DOUBLE,
    w_limit DOUBLE,
    variance_factor_centres DOUBLE,
    variance_factor_gravity DOUBLE,
    variance_factor_control DOUBLE,
    range_bias_m DOUBLE,
    sigma_range_bias_m DOUBLE,
    rig_digest VARCHAR,
    config JSON,
    config_digest VARCHAR,
    code_version VARCHAR,
    duration_s DOUBLE
);
COMMENT ON TABLE adjustments IS 'Networks of stations and marks adjusted together.';
COMMENT ON COLUMN adjustments.adjustment_id IS 'The same in every table of its results.';
COMMENT ON COLUMN adjustments.dof IS 'Observations minus unknowns.';
COMMENT ON COLUMN adjustments.sigma0 IS 'Square root of the variance factor (a priori 1); NULL without redundancy.';
COMMENT ON COLUMN adjustments.passes_global_test IS 'Whether the variance factor agrees with 1.';
COMMENT ON COLUMN adjustments.status IS 'ok or weak.';
COMMENT ON COLUMN adjustments.warnings IS 'Reasons of a weak status, as sentences.';
COMMENT ON COLUMN adjustments.datum IS 'free (place and heading of the first station) or control.';
COMMENT ON COLUMN adjustments.datum_text IS 'Origin of position and heading, as a sentence.';
COMMENT ON COLUMN adjustments.fit_method IS 'Fitting method of the centres.';
COMMENT ON COLUMN adjustments.n_control_marks IS 'Control marks in use.';
COMMENT ON COLUMN adjustments.n_observations IS 'Observed coordinates and angles that were used.';
COMMENT ON COLUMN adjustments.n_left_out IS 'Observed centres, levellings and control marks that were not used.';
COMMENT ON COLUMN adjustments.n_refused IS 'Stations that could not be connected to the others.';
COMMENT ON COLUMN adjustments.vtpv IS 'Weighted sum of squares of the residuals.';
COMMENT ON COLUMN adjustments.vtpv_limit IS 'Largest sum that passes the global test.';
COMMENT ON COLUMN adjustments.test_level IS 'Probability with which the tests reject good data.';
COMMENT ON COLUMN adjustments.w_limit IS 'Limit of w for gross errors.';
COMMENT ON COLUMN adjustments.variance_factor_centres IS 'Sum of squares over redundancy of the centres; NULL without redundancy.';
COMMENT ON COLUMN adjustments.variance_factor_gravity IS 'The same of the levelling.';
COMMENT ON COLUMN adjustments.variance_factor_control IS 'The same of the control marks.';
COMMENT ON COLUMN adjustments.range_bias_m IS 'Estimated bias of all ranges, positive is too long; NULL where it was no unknown.';
COMMENT ON COLUMN adjustments.sigma_range_bias_m IS 'Its standard deviation.';
COMMENT ON COLUMN adjustments.rig_digest IS 'The rig of all its stations; NULL where they differ.';
COMMENT ON COLUMN adjustments.config IS 'The effective configuration.';
COMMENT ON COLUMN adjustments.config_digest IS 'First 16 hexadecimal digits of the SHA-256 of the canonical configuration.';
COMMENT ON COLUMN adjustments.code_version IS 'Version of spheremark.';
COMMENT ON COLUMN adjustments.duration_s IS 'Time from the logs to the numbers.';

CREATE TABLE adjusted_stations (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    run_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    yaw_deg DOUBLE NOT NULL,
    rotation DOUBLE[] NOT NULL,
    cov_xx_m2 DOUBLE NOT NULL,
    cov_xy_m2 DOUBLE NOT NULL,
    cov_xz_m2 DOUBLE NOT NULL,
    cov_yy_m2 DOUBLE NOT NULL,
    cov_yz_m2 DOUBLE NOT NULL,
    cov_zz_m2 DOUBLE NOT NULL,
    cov_motion DOUBLE[] NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,
    sigma_yaw_deg DOUBLE NOT NULL,
    ellipse_major_m DOUBLE NOT NULL,
    ellipse_minor_m DOUBLE NOT NULL,
    ellipse_bearing_deg DOUBLE NOT NULL,
    ellipse_major_95_m DOUBLE NOT NULL,
    ellipse_minor_95_m DOUBLE NOT NULL,
    n_observations INTEGER NOT NULL,
    mean_redundancy DOUBLE,
    error_x_m DOUBLE,
    error_y_m DOUBLE,
    error_z_m DOUBLE,
    error_yaw_deg DOUBLE,
    error_3d_m DOUBLE,
    PRIMARY KEY (adjustment_id, station)
);
COMMENT ON TABLE adjusted_stations IS 'Station poses of a network in the site frame, or in the frame of the first station where it is free. Errors exist only against truth; those of a free network after it was laid on the truth (heading and place, over all stations and marks).';
COMMENT ON COLUMN adjusted_stations.station IS 'Name in the network: that of the stop, numbered where a stop was recorded more than once.';
COMMENT ON COLUMN adjusted_stations.stop IS 'The stop of the run that its centres are from.';
COMMENT ON COLUMN adjusted_stations.run_id IS 'The run that its centres are from; with stop, fit_method and marker it leads to marker_fits.';
COMMENT ON COLUMN adjusted_stations.rig_digest IS 'The rig of that run.';
COMMENT ON COLUMN adjusted_stations.x_m IS 'Position of the station.';
COMMENT ON COLUMN adjusted_stations.y_m IS 'Position of the station.';
COMMENT ON COLUMN adjusted_stations.z_m IS 'Position of the station, up.';
COMMENT ON COLUMN adjusted_stations.yaw_deg IS 'Heading of the x axis of the station, counter-clockwise from x.';
COMMENT ON COLUMN adjusted_stations.rotation IS 'R_site_station, nine numbers, rows first.';
COMMENT ON COLUMN adjusted_stations.cov_xx_m2 IS 'Covariance of the position.';
COMMENT ON COLUMN adjusted_stations.cov_motion IS 'Covariance of a small motion on the left (rotation in rad, translation in m), 36 numbers, rows first.';
COMMENT ON COLUMN adjusted_stations.sigma_3d_m IS 'Square root of the trace of the covariance of the position.';
COMMENT ON COLUMN adjusted_stations.sigma_yaw_deg IS 'Standard deviation of the heading.';
COMMENT ON COLUMN adjusted_stations.ellipse_major_m IS 'Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).';
COMMENT ON COLUMN adjusted_stations.ellipse_minor_m IS 'Semi-minor axis of the horizontal standard ellipse.';
COMMENT ON COLUMN adjusted_stations.ellipse_bearing_deg IS 'Bearing of the major axis, clockwise from y, 0 to 180.';
COMMENT ON COLUMN adjusted_stations.ellipse_major_95_m IS 'Semi-major axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN adjusted_stations.ellipse_minor_95_m IS 'Semi-minor axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN adjusted_stations.n_observations IS 'Centres used for it.';
COMMENT ON COLUMN adjusted_stations.mean_redundancy IS 'Mean redundancy of those centres, 0 to 3.';
COMMENT ON COLUMN adjusted_stations.error_x_m IS 'Estimate minus truth along x of the true site frame; NULL without truth.';
COMMENT ON COLUMN adjusted_stations.error_y_m IS 'Estimate minus truth along y.';
COMMENT ON COLUMN adjusted_stations.error_z_m IS 'Estimate minus truth along z, up.';
COMMENT ON COLUMN adjusted_stations.error_yaw_deg IS 'Estimate minus truth of the heading.';
COMMENT ON COLUMN adjusted_stations.error_3d_m IS 'Length of the error.';

CREATE TABLE adjusted_marks (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    is_control BOOLEAN NOT NULL,
    status VARCHAR NOT NULL,
    reason VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    cov_xx_m2 DOUBLE NOT NULL,
    cov_xy_m2 DOUBLE NOT NULL,
    cov_xz_m2 DOUBLE NOT NULL,
    cov_yy_m2 DOUBLE NOT NULL,
    cov_yz_m2 DOUBLE NOT NULL,
    cov_zz_m2 DOUBLE NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,
    ellipse_major_m DOUBLE NOT NULL,
    ellipse_minor_m DOUBLE NOT NULL,
    ellipse_bearing_deg DOUBLE NOT NULL,
    ellipse_major_95_m DOUBLE NOT NULL,
    ellipse_minor_95_m DOUBLE NOT NULL,
    n_observations INTEGER NOT NULL,
    mean_redundancy DOUBLE,
    error_x_m DOUBLE,
    error_y_m DOUBLE,
    error_z_m DOUBLE,
    error_3d_m DOUBLE,
    PRIMARY KEY (adjustment_id, mark)
);
COMMENT ON TABLE adjusted_marks IS 'Sphere centres of a network, in the frame of its stations. Errors as those of adjusted_stations, against the true mark nearest to it.';
COMMENT ON COLUMN adjusted_marks.mark IS 'Name of the control mark; M01, M02 ... in a free network, N01, N02 ... for marks beside control.';
COMMENT ON COLUMN adjusted_marks.is_control IS 'Whether it was observed as control.';
COMMENT ON COLUMN adjusted_marks.status IS 'ok or weak.';
COMMENT ON COLUMN adjusted_marks.reason IS 'Why it is weak; empty when it is not.';
COMMENT ON COLUMN adjusted_marks.x_m IS 'Centre of the sphere.';
COMMENT ON COLUMN adjusted_marks.y_m IS 'Centre of the sphere.';
COMMENT ON COLUMN adjusted_marks.z_m IS 'Centre of the sphere, up.';
COMMENT ON COLUMN adjusted_marks.cov_xx_m2 IS 'Covariance of the centre.';
COMMENT ON COLUMN adjusted_marks.sigma_3d_m IS 'Square root of the trace of the covariance.';
COMMENT ON COLUMN adjusted_marks.ellipse_major_m IS 'Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).';
COMMENT ON COLUMN adjusted_marks.ellipse_minor_m IS 'Semi-minor axis of the horizontal standard ellipse.';
COMMENT ON COLUMN adjusted_marks.ellipse_bearing_deg IS 'Bearing of the major axis, clockwise from y, 0 to 180.';
COMMENT ON COLUMN adjusted_marks.ellipse_major_95_m IS 'Semi-major axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN adjusted_marks.ellipse_minor_95_m IS 'Semi-minor axis of the horizontal 95 % ellipse.';
COMMENT ON COLUMN adjusted_marks.n_observations IS 'Stations that observed it.';
COMMENT ON COLUMN adjusted_marks.mean_redundancy IS 'Mean redundancy of those observations, 0 to 3.';
COMMENT ON COLUMN adjusted_marks.error_x_m IS 'Estimate minus truth along x of the true site frame; NULL without truth.';
COMMENT ON COLUMN adjusted_marks.error_y_m IS 'Estimate minus truth along y.';
COMMENT ON COLUMN adjusted_marks.error_z_m IS 'Estimate minus truth along z, up.';
COMMENT ON COLUMN adjusted_marks.error_3d_m IS 'Length of the error.';

CREATE TABLE adjusted_observations (
    adjustment_id VARCHAR NOT NULL,
    kind VARCHAR NOT NULL,
    station VARCHAR,
    marker VARCHAR,
    mark VARCHAR,
    used BOOLEAN NOT NULL,
    reason VARCHAR NOT NULL,
    residual_x_m DOUBLE,
    residual_y_m DOUBLE,
    residual_z_m DOUBLE,
    residual_x_deg DOUBLE,
    residual_y_deg DOUBLE,
    redundancy DOUBLE,
    w DOUBLE,
    minimal_detectable_bias_m DOUBLE,
    minimal_detectable_bias_deg DOUBLE,
    external_reliability_station_m DOUBLE,
    external_reliability_mark_m DOUBLE
);
COMMENT ON TABLE adjusted_observations IS 'Observations of a network, used or left out: centres, levelling of the stations, control marks; residuals are observed minus computed, along the axes of the network.';
COMMENT ON COLUMN adjusted_observations.kind IS 'centre, gravity or control.';
COMMENT ON COLUMN adjusted_observations.station IS 'The observing station; NULL for a control mark.';
COMMENT ON COLUMN adjusted_observations.marker IS 'The observed marker; NULL where it is no centre.';
COMMENT ON COLUMN adjusted_observations.mark IS 'The mark; NULL where none is known.';
COMMENT ON COLUMN adjusted_observations.used IS 'Whether the network uses it.';
COMMENT ON COLUMN adjusted_observations.reason IS 'Reason of the omission; empty when it is used.';
COMMENT ON COLUMN adjusted_observations.residual_x_m IS 'Residual of a centre or a control mark; NULL of a marker that is no mark.';
COMMENT ON COLUMN adjusted_observations.residual_y_m IS 'The same along y.';
COMMENT ON COLUMN adjusted_observations.residual_z_m IS 'The same along z, up.';
COMMENT ON COLUMN adjusted_observations.residual_x_deg IS 'Residual of a levelling: of the up direction along x.';
COMMENT ON COLUMN adjusted_observations.residual_y_deg IS 'The same along y.';
COMMENT ON COLUMN adjusted_observations.redundancy IS 'Redundancy of its coordinates together: of 3, of levelling of 2.';
COMMENT ON COLUMN adjusted_observations.w IS 'Largest w-statistic of its coordinates; NULL where not testable or not used.';
COMMENT ON COLUMN adjusted_observations.minimal_detectable_bias_m IS 'Smallest bias that the w-test would find with the power of the configuration; NULL where none is.';
COMMENT ON COLUMN adjusted_observations.minimal_detectable_bias_deg IS 'The same of a levelling.';
COMMENT ON COLUMN adjusted_observations.external_reliability_station_m IS 'Shift of the station by an undetected bias of that size.';
COMMENT ON COLUMN adjusted_observations.external_reliability_mark_m IS 'Shift of the mark by an undetected bias of that size.';

CREATE TABLE refused_stations (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    code VARCHAR NOT NULL,
    reason VARCHAR NOT NULL
);
COMMENT ON TABLE refused_stations IS 'Stations and logs that are not part of a network, with the reason.';
COMMENT ON COLUMN refused_stations.station IS 'Name of the stop, or of a log without stops.';
COMMENT ON COLUMN refused_stations.code IS 'Stable code of the error, for programs.';
COMMENT ON COLUMN refused_stations.reason IS 'The reason, as a sentence.';

CREATE TABLE control_checks (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    n_observations INTEGER NOT NULL,
    difference_x_m DOUBLE NOT NULL,
    difference_y_m DOUBLE NOT NULL,
    difference_z_m DOUBLE NOT NULL,
    difference_3d_m DOUBLE NOT NULL,
    sigma_x_m DOUBLE NOT NULL,
    sigma_y_m DOUBLE NOT NULL,
    sigma_z_m DOUBLE NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,
    PRIMARY KEY (adjustment_id, mark)
);
COMMENT ON TABLE control_checks IS 'Each control mark left out in turn: its position from the network without its coordinates, minus the given one. No error against truth: both have sigmas. A mark that the others do not determine has no row.';
COMMENT ON COLUMN control_checks.n_observations IS 'Stations that observed it.';
COMMENT ON COLUMN control_checks.difference_x_m IS 'Predicted minus given along x of the site frame.';
COMMENT ON COLUMN control_checks.difference_y_m IS 'Predicted minus given along y of the site frame.';
COMMENT ON COLUMN control_checks.difference_z_m IS 'Predicted minus given along z of the site frame, up.';
COMMENT ON COLUMN control_checks.difference_3d_m IS 'Length of the difference.';
COMMENT ON COLUMN control_checks.sigma_x_m IS 'Standard deviation of that difference, prediction and given mark together.';
COMMENT ON COLUMN control_checks.sigma_3d_m IS 'Square root of the trace of the covariance of the difference.';

CREATE TABLE repeated_stops (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    again VARCHAR NOT NULL,
    n_marks INTEGER NOT NULL,
    apart_x_m DOUBLE NOT NULL,
    apart_y_m DOUBLE NOT NULL,
    apart_z_m DOUBLE NOT NULL,
    apart_3d_m DOUBLE NOT NULL,
    difference_rms_m DOUBLE NOT NULL,
    predicted_rms_m DOUBLE NOT NULL,
    PRIMARY KEY (adjustment_id, station, again)
);
COMMENT ON TABLE repeated_stops IS 'Stations of a network at one position: their centres after a rigid motion. No error against truth: errors that both share do not show.';
COMMENT ON COLUMN repeated_stops.again IS 'The second station.';
COMMENT ON COLUMN repeated_stops.n_marks IS 'Marks that both observed.';
COMMENT ON COLUMN repeated_stops.apart_x_m IS 'Position of the second station minus the first, along x.';
COMMENT ON COLUMN repeated_stops.apart_y_m IS 'The same along y.';
COMMENT ON COLUMN repeated_stops.apart_z_m IS 'The same along z, up.';
COMMENT ON COLUMN repeated_stops.apart_3d_m IS 'Distance of the two stations.';
COMMENT ON COLUMN repeated_stops.difference_rms_m IS 'Root mean square 3-D difference of their centres after a rigid motion.';
COMMENT ON COLUMN repeated_stops.predicted_rms_m IS 'Its prediction from the covariances of the centres.';

-- Plans of marker placements: predictions are stored; the view placements reads the achieved
-- accuracy from the newest results of the survey.

CREATE TABLE terrains (
    terrain_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    size_bytes BIGINT NOT NULL,
    url VARCHAR NOT NULL,
    uploaded_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE terrains IS 'Elevation models and clouds that were uploaded to plan on.';
COMMENT ON COLUMN terrains.terrain_id IS 'SHA-256 of the bytes of the file.';
COMMENT ON COLUMN terrains.name IS 'Name of the uploaded file.';
COMMENT ON COLUMN terrains.size_bytes IS 'Length of the file.';
COMMENT ON COLUMN terrains.url IS 'Location of the file.';
COMMENT ON COLUMN terrains.uploaded_at IS 'Instant of the upload (UTC).';

CREATE TABLE plans (
    placement_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    survey_id VARCHAR,
    site_name VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    tolerance_m DOUBLE NOT NULL,
    marks JSON NOT NULL,
    n_marks INTEGER NOT NULL,
    model_version VARCHAR NOT NULL,
    model_source VARCHAR NOT NULL,
    request JSON NOT NULL,
    created_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE plans IS 'Stored arrangements of marks.';
COMMENT ON COLUMN plans.placement_id IS 'Given by the catalogue; the same in planned_stops and placements.';
COMMENT ON COLUMN plans.name IS 'Name of the user.';
COMMENT ON COLUMN plans.survey_id IS 'Survey of the plan; NULL without one.';
COMMENT ON COLUMN plans.site_name IS 'Terrain of the plan.';
COMMENT ON COLUMN plans.resection_method IS 'free_station, or paper (three circles).';
COMMENT ON COLUMN plans.tolerance_m IS '3-D error that was accepted.';
COMMENT ON COLUMN plans.marks IS 'The arrangement: names, centres in the site frame [m] and heights of poles [m].';
COMMENT ON COLUMN plans.n_marks IS 'Number of marks.';
COMMENT ON COLUMN plans.model_version IS 'Digest of the model of centres behind the prediction.';
COMMENT ON COLUMN plans.model_source IS 'sensor, or fitted (from the marker_fits of own surveys).';
COMMENT ON COLUMN plans.request IS 'The complete request.';
COMMENT ON COLUMN plans.created_at IS 'Instant of storage (UTC).';

CREATE TABLE planned_stops (
    placement_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    place INTEGER NOT NULL,
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    n_seen INTEGER NOT NULL,
    n_used INTEGER NOT NULL,
    sigma_3d_m DOUBLE,
    probability_within_tolerance DOUBLE NOT NULL,
    included_angle_min_deg DOUBLE,
    included_angle_max_deg DOUBLE,
    dop DOUBLE,
    reason VARCHAR NOT NULL,
    PRIMARY KEY (placement_id, stop)
);
COMMENT ON TABLE planned_stops IS 'Predictions of a stored plan at each of its stops.';
COMMENT ON COLUMN planned_stops.place IS 'Its place in the plan, from 0.';
COMMENT ON COLUMN planned_stops.x_m IS 'Planned place of the LiDAR in the site frame.';
COMMENT ON COLUMN planned_stops.y_m IS 'Planned place of the LiDAR in the site frame.';
COMMENT ON COLUMN planned_stops.z_m IS 'Planned place of the LiDAR in the site frame, up.';
COMMENT ON COLUMN planned_stops.n_seen IS 'Marks that can be found from there.';
COMMENT ON COLUMN planned_stops.n_used IS 'Marks used for the position.';
COMMENT ON COLUMN planned_stops.sigma_3d_m IS 'Predicted: square root of the trace of the covariance of the position; NULL where there is none.';
COMMENT ON COLUMN planned_stops.probability_within_tolerance IS 'Predicted probability that the 3-D error is within the tolerance, 0 to 1.';
COMMENT ON COLUMN planned_stops.included_angle_min_deg IS 'Least angle between two used marks.';
COMMENT ON COLUMN planned_stops.included_angle_max_deg IS 'Greatest angle between two used marks.';
COMMENT ON COLUMN planned_stops.dop IS 'Dilution of precision; NULL where there is no position.';
COMMENT ON COLUMN planned_stops.reason IS 'Reason of a missing or weak position; else empty.';

-- Files: products of all stops of a survey, and documents of one result.

CREATE TABLE site_products (
    product_id VARCHAR NOT NULL,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    kind VARCHAR NOT NULL,
    url VARCHAR NOT NULL,
    sha256 VARCHAR NOT NULL,
    size_bytes BIGINT NOT NULL,
    n_points BIGINT NOT NULL,
    n_stations INTEGER NOT NULL,
    poses VARCHAR NOT NULL,
    adjustment_id VARCHAR,
    min_x_m DOUBLE NOT NULL,
    min_y_m DOUBLE NOT NULL,
    min_z_m DOUBLE NOT NULL,
    max_x_m DOUBLE NOT NULL,
    max_y_m DOUBLE NOT NULL,
    max_z_m DOUBLE NOT NULL,
    cell_m DOUBLE,
    share_known DOUBLE,
    sigma_median_m DOUBLE,
    config_digest VARCHAR NOT NULL,
    code_version VARCHAR NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    PRIMARY KEY (product_id, kind)
);
COMMENT ON TABLE site_products IS 'Files made of all stops of a survey: clouds in the site frame and elevation models.';
COMMENT ON COLUMN site_products.product_id IS 'The same for all files of one job.';
COMMENT ON COLUMN site_products.kind IS 'laz, e57 or geotiff.';
COMMENT ON COLUMN site_products.url IS 'Location of the file.';
COMMENT ON COLUMN site_products.sha256 IS 'Digest of its bytes.';
COMMENT ON COLUMN site_products.size_bytes IS 'Length of the file.';
COMMENT ON COLUMN site_products.n_points IS 'Returns of the cloud, or of the heights.';
COMMENT ON COLUMN site_products.n_stations IS 'Stations whose returns are in it.';
COMMENT ON COLUMN site_products.poses IS 'Origin of the poses: control or free (an adjustment), or fixes (each station alone).';
COMMENT ON COLUMN site_products.adjustment_id IS 'The adjustment that the poses are from; NULL where each station was positioned alone.';
COMMENT ON COLUMN site_products.min_x_m IS 'Least coordinate in the site frame.';
COMMENT ON COLUMN site_products.min_y_m IS 'Least coordinate in the site frame.';
COMMENT ON COLUMN site_products.min_z_m IS 'Least coordinate in the site frame, up.';
COMMENT ON COLUMN site_products.max_x_m IS 'Greatest coordinate in the site frame.';
COMMENT ON COLUMN site_products.max_y_m IS 'Greatest coordinate in the site frame.';
COMMENT ON COLUMN site_products.max_z_m IS 'Greatest coordinate in the site frame, up.';
COMMENT ON COLUMN site_products.cell_m IS 'Edge of a cell of an elevation model.';
COMMENT ON COLUMN site_products.share_known IS 'Share of its cells with observed ground.';
COMMENT ON COLUMN site_products.sigma_median_m IS 'Median of the standard deviations of its heights.';

CREATE TABLE documents (
    result_id VARCHAR NOT NULL,
    name VARCHAR NOT NULL,
    media_type VARCHAR NOT NULL,
    text VARCHAR NOT NULL,
    PRIMARY KEY (result_id, name)
);
COMMENT ON TABLE documents IS 'Files that a result can be downloaded as.';
COMMENT ON COLUMN documents.result_id IS 'adjustment_id or calibration_id.';
COMMENT ON COLUMN documents.name IS 'Name of the file.';
COMMENT ON COLUMN documents.text IS 'The file itself.';

-- Views: the newest results, and their accuracy.

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

CREATE VIEW latest_calibrations AS
SELECT s.name AS survey, c.* FROM calibrations AS c JOIN surveys AS s USING (survey_id)
QUALIFY row_number() OVER (PARTITION BY c.survey_id ORDER BY c.finished_at DESC) = 1;
COMMENT ON VIEW latest_calibrations IS 'The newest calibration of each survey.';

CREATE VIEW latest_adjustments AS
SELECT s.name AS survey, a.* FROM adjustments AS a JOIN surveys AS s USING (survey_id)
QUALIFY row_number() OVER (PARTITION BY a.survey_id, a.datum ORDER BY a.finished_at DESC) = 1;
COMMENT ON VIEW latest_adjustments IS 'The newest free and the newest controlled adjustment of each survey.';

CREATE VIEW latest_adjusted_stations AS
SELECT a.survey_id, a.survey, a.datum, x.*
FROM adjusted_stations AS x JOIN latest_adjustments AS a USING (adjustment_id);
COMMENT ON VIEW latest_adjusted_stations IS 'adjusted_stations of the newest free and the newest controlled adjustment of each survey.';

CREATE VIEW latest_adjusted_marks AS
SELECT a.survey_id, a.survey, a.datum, x.*
FROM adjusted_marks AS x JOIN latest_adjustments AS a USING (adjustment_id);
COMMENT ON VIEW latest_adjusted_marks IS 'adjusted_marks of the newest free and the newest controlled adjustment of each survey.';

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
COMMENT ON COLUMN accuracy_by_distance.n_errors IS 'Fits whose error is known.';
COMMENT ON COLUMN accuracy_by_distance.mean_n_points IS 'Mean number of returns of a fit.';
COMMENT ON COLUMN accuracy_by_distance.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_mean_m IS 'Mean error; the study publishes this one.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_rms_m IS 'Root mean square error.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_p95_m IS '95th percentile of the error; the tolerance holds when it is at most that.';
COMMENT ON COLUMN accuracy_by_distance.error_3d_max_m IS 'Largest error.';
COMMENT ON COLUMN accuracy_by_distance.error_radial_mean_m IS 'Mean error along the line of sight; positive is too far.';

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
COMMENT ON COLUMN accuracy_by_point_count.n_errors IS 'Fits whose error is known.';
COMMENT ON COLUMN accuracy_by_point_count.mean_range_m IS 'Mean distance of the fits.';
COMMENT ON COLUMN accuracy_by_point_count.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_mean_m IS 'Mean error; the study publishes this one.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_rms_m IS 'Root mean square error.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_p95_m IS '95th percentile of the error; the tolerance holds when it is at most that.';
COMMENT ON COLUMN accuracy_by_point_count.error_3d_max_m IS 'Largest error.';

CREATE VIEW accuracy_by_included_angle AS
SELECT r.survey_id, s.name AS survey, x.fit_method, x.resection_method, x.n_marks,
    10 * floor(x.included_angle_max_deg / 10) AS included_angle_from_deg,
    10 * floor(x.included_angle_max_deg / 10) + 10 AS included_angle_to_deg,
    count(*) AS n_resections, count(x.error_3d_m) AS n_errors,
    sqrt(avg(x.sigma_horizontal_m ^ 2)) AS sigma_horizontal_rms_m,
    sqrt(avg(x.sigma_3d_m ^ 2)) AS sigma_3d_rms_m,
    sqrt(avg(x.error_horizontal_m ^ 2)) AS error_horizontal_rms_m,
    avg(x.error_3d_m) AS error_3d_mean_m, sqrt(avg(x.error_3d_m ^ 2)) AS error_3d_rms_m,
    quantile_cont(x.error_3d_m, 0.95) AS error_3d_p95_m, max(x.error_3d_m) AS error_3d_max_m
FROM resections AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
GROUP BY ALL ORDER BY ALL;
COMMENT ON VIEW accuracy_by_included_angle IS 'Errors of stations positioned from pairs and triples of marks in bins of 10 degrees of included angle (of triples the largest), newest runs.';
COMMENT ON COLUMN accuracy_by_included_angle.n_marks IS 'Marks per position; 2 for pairs, 3 for triples.';
COMMENT ON COLUMN accuracy_by_included_angle.included_angle_from_deg IS 'Lower end of the bin, included.';
COMMENT ON COLUMN accuracy_by_included_angle.included_angle_to_deg IS 'Upper end of the bin, excluded.';
COMMENT ON COLUMN accuracy_by_included_angle.n_resections IS 'Positions in the bin.';
COMMENT ON COLUMN accuracy_by_included_angle.n_errors IS 'Positions whose error is known.';
COMMENT ON COLUMN accuracy_by_included_angle.sigma_horizontal_rms_m IS 'Predicted: root mean square of sigma_horizontal_m.';
COMMENT ON COLUMN accuracy_by_included_angle.sigma_3d_rms_m IS 'Predicted: root mean square of sigma_3d_m.';
COMMENT ON COLUMN accuracy_by_included_angle.error_horizontal_rms_m IS 'Root mean square error in the plane.';
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
COMMENT ON COLUMN accuracy_by_stop.n_markers IS 'Markers used for the station.';
COMMENT ON COLUMN accuracy_by_stop.station_sigma_3d_m IS 'Predicted error of the station.';
COMMENT ON COLUMN accuracy_by_stop.station_error_3d_m IS 'Error of the station.';

CREATE VIEW placements AS
SELECT p.placement_id, p.name, p.survey_id, s.name AS survey, p.site_name, p.marks, p.n_marks,
    p.model_version, p.model_source, p.resection_method, p.tolerance_m, x.stop, x.n_seen, x.n_used,
    x.sigma_3d_m, x.probability_within_tolerance, x.included_angle_min_deg,
    x.included_angle_max_deg, x.dop, x.reason, f.run_id, f.n_markers,
    f.sigma_3d_m AS achieved_sigma_3d_m, f.error_3d_m, f.error_3d_m <= p.tolerance_m AS is_within_tolerance,
    p.created_at
FROM plans AS p JOIN planned_stops AS x USING (placement_id)
LEFT JOIN surveys AS s USING (survey_id)
LEFT JOIN latest_station_fixes AS f ON f.survey_id = p.survey_id AND f.stop = x.stop
    AND f.fit_method = 'along_beam' AND f.resection_method = p.resection_method
ORDER BY p.created_at DESC, p.placement_id, x.place;
COMMENT ON VIEW placements IS 'Prediction of a stored plan per stop and, once a stop of that name is surveyed, the result.';
COMMENT ON COLUMN placements.run_id IS 'Run that surveyed the stop; NULL until then.';
COMMENT ON COLUMN placements.n_markers IS 'Markers used for the position once surveyed.';
COMMENT ON COLUMN placements.achieved_sigma_3d_m IS 'Sigma of the position once surveyed.';
COMMENT ON COLUMN placements.error_3d_m IS 'Error of the position once surveyed; NULL without truth.';
COMMENT ON COLUMN placements.is_within_tolerance IS 'Whether that error is within the tolerance.';
