-- The database is a public interface: units are in the names of columns, an unknown value is NULL,
-- nothing is overwritten (a new run is a new set of rows). Lengths in metres, angles in degrees,
-- instants in UTC. error_* columns exist only against truth; sigma_* are predictions; residuals are
-- observed minus computed. Coordinates are in the station frame unless a comment says otherwise.
--
-- A comment above a CREATE describes the table or view, a comment behind a column the column: both
-- become comments of the database.

-- Surveys, their marks and logs.

-- A field with its control marks and the logs that were recorded there.
CREATE TABLE surveys (
    survey_id VARCHAR PRIMARY KEY,  -- Given by the catalogue; the same in every table.
    name VARCHAR NOT NULL UNIQUE,  -- Name of the user, unique.
    tolerance_m DOUBLE NOT NULL,  -- 3-D error that the survey accepts.
    created_at TIMESTAMPTZ NOT NULL,  -- Instant of creation (UTC).
    rig_digest VARCHAR  -- Rig that its jobs use where they name none; NULL: the one that each log describes.
);

-- Known sphere centres in the site frame.
CREATE TABLE control_marks (
    survey_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,  -- Name of the mark.
    place INTEGER NOT NULL,  -- Its place in the file, from 0.
    x_m DOUBLE NOT NULL,  -- Centre of the sphere in the site frame.
    y_m DOUBLE NOT NULL,  -- Centre of the sphere in the site frame.
    z_m DOUBLE NOT NULL,  -- Centre of the sphere in the site frame, up.
    sigma_x_m DOUBLE NOT NULL,  -- Standard deviation of x; 0 where it is taken as exact.
    sigma_y_m DOUBLE NOT NULL,  -- Standard deviation of y; 0 where it is taken as exact.
    sigma_z_m DOUBLE NOT NULL,  -- Standard deviation of z; 0 where it is taken as exact.
    PRIMARY KEY (survey_id, mark)
);

-- Rigs of runs, of calibrations and of users, as JSON.
CREATE TABLE rigs (
    rig_digest VARCHAR PRIMARY KEY,  -- First 16 hexadecimal digits of the SHA-256 of the canonical rig.
    name VARCHAR NOT NULL,
    rig JSON NOT NULL  -- Mounting, laser table and offsets, with units in the keys.
);

-- Uploaded logs; recording_id is the SHA-256 of the bytes, verdict is ok, weak or refused, preflight says why.
CREATE TABLE recordings (
    recording_id VARCHAR PRIMARY KEY,  -- SHA-256 of the bytes of the log.
    name VARCHAR NOT NULL,  -- Stem of the name of the uploaded file.
    size_bytes BIGINT NOT NULL,  -- Length of the file.
    uploaded_at TIMESTAMPTZ NOT NULL,  -- Instant of the upload (UTC).
    url VARCHAR NOT NULL,  -- Location of the file.
    verdict VARCHAR NOT NULL,  -- ok, weak or refused.
    preflight JSON NOT NULL  -- The whole preflight report.
);

-- Logs that were uploaded for a survey; those that its jobs read belong to it too.
CREATE TABLE survey_recordings (
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    PRIMARY KEY (survey_id, recording_id)
);

-- Truth, where it is known.

-- True sphere centres in the site frame; for comparison only, never an input of a job.
CREATE TABLE true_marks (
    survey_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,  -- Name of the mark in the simulator.
    place INTEGER NOT NULL,  -- Its place in the file, from 0.
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    PRIMARY KEY (survey_id, mark)
);

-- True poses of the base frame in the site frame; for comparison only, never an input of a job.
CREATE TABLE true_stops (
    survey_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,  -- Name of the stop, as in the tables of results.
    x_m DOUBLE NOT NULL,
    y_m DOUBLE NOT NULL,
    z_m DOUBLE NOT NULL,
    yaw_deg DOUBLE NOT NULL,  -- Heading in R_site_base = Rz(yaw) Ry(pitch) Rx(roll), counter-clockwise from x.
    pitch_deg DOUBLE NOT NULL,  -- Rotation about y in the same product.
    roll_deg DOUBLE NOT NULL,  -- Rotation about x in the same product.
    PRIMARY KEY (survey_id, stop)
);

-- Rig, seed and scenario of a simulated world; for comparison only, never an input of a job.
CREATE TABLE true_worlds (
    survey_id VARCHAR PRIMARY KEY,
    rig JSON,  -- The true rig, NULL when unknown.
    about JSON NOT NULL  -- Seed, scenario and the like.
);

-- Jobs and runs.

-- Jobs; status is accepted, running, successful, failed or dismissed.
CREATE TABLE jobs (
    job_id VARCHAR PRIMARY KEY,
    kind VARCHAR NOT NULL,  -- Kind of the job, for instance process.
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR,
    config JSON NOT NULL,  -- The effective configuration.
    status VARCHAR NOT NULL,  -- accepted, running, successful, failed or dismissed.
    progress_percent DOUBLE NOT NULL,  -- 0 to 100, as of this snapshot.
    message VARCHAR NOT NULL,  -- Last step, as a sentence.
    attempts INTEGER NOT NULL,  -- Number of starts.
    created_at TIMESTAMPTZ NOT NULL,  -- Instant of the request (UTC).
    started_at TIMESTAMPTZ,  -- Start of the last attempt (UTC).
    finished_at TIMESTAMPTZ,  -- End of the job (UTC).
    error_code VARCHAR,  -- Stable code of the error, for programs.
    error_reason VARCHAR,  -- Reason of the failure, as a sentence.
    error_traceback VARCHAR,  -- Traceback of the failure.
    options JSON DEFAULT '{}'  -- Options beside the configuration: rig (a digest), recordings (of a job that reads several), and those of its kind.
);

-- Requests that were sent with an Idempotency-Key, so that the same one again makes nothing new.
CREATE TABLE idempotency_keys (
    key VARCHAR PRIMARY KEY,  -- The key that the sender chose.
    request VARCHAR NOT NULL,  -- SHA-256 of the request.
    job_id VARCHAR NOT NULL,  -- The job that it made.
    created_at TIMESTAMPTZ NOT NULL  -- Instant of the request (UTC).
);

-- A recording processed with one configuration by one version of the code.
CREATE TABLE runs (
    run_id VARCHAR PRIMARY KEY,  -- The same in every table of results.
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    config JSON NOT NULL,  -- The effective configuration.
    config_digest VARCHAR NOT NULL,  -- First 16 hexadecimal digits of the SHA-256 of the canonical configuration.
    code_version VARCHAR NOT NULL,  -- Version of spheremark.
    rig_digest VARCHAR NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,  -- End of the run (UTC).
    duration_s DOUBLE NOT NULL,  -- Time from the log to the numbers.
    peak_memory_bytes BIGINT  -- Largest resident size of the worker process.
);

-- Results of a run.

-- One full scan of a run: its acquisition and its weaknesses.
CREATE TABLE stops (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,  -- Name of the stop: that of the log, numbered when the log holds several.
    n_returns BIGINT NOT NULL,  -- Returns that were stitched.
    coverage_deg DOUBLE NOT NULL,  -- Rotation of the gimbal during the scan, at most 360.
    duration_s DOUBLE NOT NULL,  -- Time from the first pulse to the last.
    roll_deg DOUBLE NOT NULL,  -- Rotation of the base in R_station_base = Ry(pitch) Rx(roll).
    pitch_deg DOUBLE NOT NULL,  -- Rotation of the base in R_station_base = Ry(pitch) Rx(roll).
    sigma_levelling_deg DOUBLE NOT NULL,  -- Standard deviation of roll and of pitch.
    sigma_heading_deg DOUBLE NOT NULL,  -- Standard deviation of the heading from mounting and encoder; it rotates all centres of the stop together and is part of their covariances.
    sigma_clock_deg DOUBLE NOT NULL,  -- Standard deviation of the heading from the clocks of gimbal and LiDAR; it is part of the station's heading alone.
    cloud_url VARCHAR,  -- Location of the thinned cloud; NULL without one.
    notes VARCHAR[] NOT NULL,  -- Weaknesses of the scan, as sentences.
    timings_s JSON NOT NULL,  -- Duration of each step.
    PRIMARY KEY (run_id, stop)
);

-- Sphere centres in the station frame, one row per stop, marker and fitting method; covariances without levelling.
CREATE TABLE marker_fits (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,  -- along_beam or silhouette (ours), astm_e3125, free_radius, algebraic, or paper (the study).
    marker VARCHAR NOT NULL,  -- M01, M02 ... by azimuth, within one stop: the same sphere by every method; a method that refused it has no row.
    mark VARCHAR,  -- Control mark that it was matched to by the first resection method; NULL when to none.
    status VARCHAR NOT NULL,  -- ok or weak.
    reason VARCHAR NOT NULL,  -- Why it is weak; empty when it is not.
    x_m DOUBLE NOT NULL,  -- Centre in the station frame.
    y_m DOUBLE NOT NULL,  -- Centre in the station frame.
    z_m DOUBLE NOT NULL,  -- Centre in the station frame, up.
    cov_xx_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_xy_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_xz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_yy_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_yz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_zz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    sigma_3d_m DOUBLE,  -- Square root of the trace of the covariance, heading included.
    range_m DOUBLE NOT NULL,  -- From the mean beam origin to the centre.
    azimuth_deg DOUBLE NOT NULL,  -- Direction to the centre in the station frame, counter-clockwise from x.
    elevation_deg DOUBLE NOT NULL,  -- Direction to the centre above the horizon of the station.
    n_points INTEGER NOT NULL,  -- Returns that the fit used.
    n_rejected INTEGER NOT NULL,  -- Returns of the candidate that the fit did not use.
    n_rings INTEGER NOT NULL,  -- Different lasers among the used returns; 0 when the log has no lasers.
    coverage DOUBLE,  -- Share of the visible half of the sphere that has returns, 0 to 1.
    rms_m DOUBLE,  -- Root mean square of the residuals (observed minus computed along the beam).
    sigma0 DOUBLE,  -- Square root of the variance factor; 1 means noise as assumed.
    radius_m DOUBLE NOT NULL,  -- Assumed radius.
    radius_free_m DOUBLE,  -- Radius when estimated together with the centre; NULL when the returns do not determine it.
    sigma_radius_free_m DOUBLE,  -- Standard deviation of radius_free_m.
    mean_intensity DOUBLE,  -- Mean reflectivity of the used returns, 0 to 255.
    incidence_deg DOUBLE,  -- Mean angle between the used beams and the normals of the sphere.
    variant VARCHAR,  -- Which form of its method ran, where it has several; else empty.
    error_x_m DOUBLE,  -- Estimate minus truth along x of the station frame; NULL without truth or for a false marker.
    error_y_m DOUBLE,  -- Estimate minus truth along y of the station frame.
    error_z_m DOUBLE,  -- Estimate minus truth along z of the station frame, up.
    error_radial_m DOUBLE,  -- Estimate minus truth along the line of sight; positive is too far.
    error_3d_m DOUBLE,  -- Length of the error.
    sigma_range_shared_m DOUBLE,  -- Standard deviation of the range error that all centres of the stop share, part of their covariances; NULL where the method gives none.
    range_by_optics_m DOUBLE[],  -- Change of the range to the centre with each unknown of the optics: divergence, width at the window, echo weight.
    optics DOUBLE[],  -- What the scan shows of these three: estimates, then the inverse of their covariance (nine), then sigmas before any scan, then those of the profile; NULL where the method gives none.
    probability DOUBLE,  -- Posterior probability that it is a marker.
    hypothesis VARCHAR NOT NULL,  -- The most likely other hypothesis, with its odds.
    PRIMARY KEY (run_id, stop, fit_method, marker)
);

-- Possible markers, which enter nothing, and candidates that are no markers, with the reason.
CREATE TABLE rejections (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    x_m DOUBLE NOT NULL,  -- Position in the station frame.
    y_m DOUBLE NOT NULL,  -- Position in the station frame.
    z_m DOUBLE NOT NULL,  -- Position in the station frame.
    n_points INTEGER NOT NULL,  -- Number of its returns.
    reason VARCHAR NOT NULL,  -- Reason of the rejection, as a sentence.
    probability DOUBLE,  -- Posterior probability that it is a marker; NULL where it was not computed.
    is_possible BOOLEAN NOT NULL  -- Whether it may be a marker: too probable to be refused, not probable enough to be used.
);

-- Station poses in the site frame, one row per stop, fitting and resection method; status is ok, weak or failed.
CREATE TABLE station_fixes (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,  -- Method of positioning from the markers.
    status VARCHAR NOT NULL,  -- ok, weak or failed.
    reason VARCHAR NOT NULL,  -- Why it is weak or failed; empty when it is ok.
    x_m DOUBLE,  -- Position of the station in the site frame; NULL when failed.
    y_m DOUBLE,  -- Position of the station in the site frame.
    z_m DOUBLE,  -- Position of the station in the site frame, up.
    yaw_deg DOUBLE,  -- Heading of the x axis of the station in the site frame, counter-clockwise from x.
    rotation DOUBLE[],  -- R_site_station, nine numbers, rows first.
    cov_xx_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_xy_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_xz_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_yy_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_yz_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_zz_m2 DOUBLE,  -- Covariance of the position in the site frame.
    cov_motion DOUBLE[],  -- Covariance of a small motion on the left (rotation in rad, translation in m, site frame), 36 numbers, rows first.
    sigma_3d_m DOUBLE,  -- Square root of the trace of the covariance of the position.
    sigma_yaw_deg DOUBLE,  -- Standard deviation of the heading.
    ellipse_major_m DOUBLE,  -- Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).
    ellipse_minor_m DOUBLE,  -- Semi-minor axis of the horizontal standard ellipse.
    ellipse_bearing_deg DOUBLE,  -- Bearing of the major axis, clockwise from y of the site frame, 0 to 180.
    ellipse_major_95_m DOUBLE,  -- Semi-major axis of the horizontal 95 % ellipse.
    ellipse_minor_95_m DOUBLE,  -- Semi-minor axis of the horizontal 95 % ellipse.
    n_markers INTEGER NOT NULL,  -- Markers used for the fix.
    dof INTEGER,  -- Observations, gravity included, minus unknowns.
    sigma0 DOUBLE,  -- Square root of the variance factor; NULL without redundancy.
    passes_global_test BOOLEAN,  -- Whether the variance factor agrees with 1; true without redundancy.
    included_angle_min_deg DOUBLE,  -- Smallest 3-D angle at the station between two used marks.
    included_angle_max_deg DOUBLE,  -- Largest 3-D angle at the station between two used marks.
    error_x_m DOUBLE,  -- Estimate minus truth along x of the site frame; NULL without truth.
    error_y_m DOUBLE,  -- Estimate minus truth along y of the site frame.
    error_z_m DOUBLE,  -- Estimate minus truth along z of the site frame, up.
    error_yaw_deg DOUBLE,  -- Estimate minus truth of the heading.
    error_horizontal_m DOUBLE,  -- Length of the horizontal error.
    error_3d_m DOUBLE,  -- Length of the error.
    dop DOUBLE,  -- Dilution of precision: 3-D sigma of the position, levelled, for observations that all have a sigma of 1; NULL where there is none.
    PRIMARY KEY (run_id, stop, fit_method, resection_method)
);

-- One row per marker and fix: residuals in the site frame (observed minus computed), redundancy (of 3) and reliability.
CREATE TABLE observations (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,
    mark VARCHAR,
    used BOOLEAN NOT NULL,  -- Whether the fix uses the marker.
    reason VARCHAR NOT NULL,  -- Reason of the omission; empty when it is used.
    residual_x_m DOUBLE,  -- Observed minus computed along x of the site frame; NULL when not used.
    residual_y_m DOUBLE,  -- Observed minus computed along y of the site frame.
    residual_z_m DOUBLE,  -- Observed minus computed along z of the site frame.
    redundancy DOUBLE,  -- Redundancy of its three coordinates together, 0 to 3.
    w DOUBLE,  -- Largest w-statistic of its coordinates; NULL where not testable.
    minimal_detectable_bias_m DOUBLE,  -- Smallest bias that the w-test would find with the power of the configuration; NULL where none is.
    external_reliability_m DOUBLE,  -- Shift of the station by an undetected bias of that size; NULL where none is found.
    shift_without_m DOUBLE,  -- How far the station moves when this marker is left out; NULL for markers that are not used, and for trilateration.
    PRIMARY KEY (run_id, stop, fit_method, resection_method, marker)
);

-- The station positioned from each pair and each triple of marks alone (with gravity), in the site frame, by each resection method.
CREATE TABLE resections (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    resection_method VARCHAR NOT NULL,
    marks VARCHAR[] NOT NULL,  -- The control marks that were used.
    n_marks INTEGER NOT NULL,  -- How many; 2 for pairs, 3 for triples.
    included_angle_deg DOUBLE NOT NULL,  -- 3-D angle at the station between the two centres; of three the smallest of the three angles.
    included_angle_horizontal_deg DOUBLE NOT NULL,  -- The smallest angle in the levelled plane.
    sigma_3d_m DOUBLE,  -- Square root of the trace of the covariance of the position.
    x_m DOUBLE,  -- Position of the station in the site frame.
    y_m DOUBLE,  -- Position of the station in the site frame.
    z_m DOUBLE,  -- Position of the station in the site frame, up.
    error_3d_m DOUBLE,  -- Length of estimate minus truth; NULL without truth.
    included_angle_max_deg DOUBLE,  -- The same; of three the largest of the three angles.
    sigma_horizontal_m DOUBLE,  -- Square root of the trace of the covariance of x and y.
    error_horizontal_m DOUBLE  -- Length of estimate minus truth in the plane; NULL without truth.
);

-- Calibrations.

-- Rigs estimated from scans: parameters in SI units, their covariance, and the resulting rig.
CREATE TABLE calibrations (
    calibration_id VARCHAR PRIMARY KEY,  -- The same in every table of its results.
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,  -- The resulting rig.
    parameters VARCHAR[] NOT NULL,  -- Names of the parameters, in SI units.
    covariance JSON NOT NULL,  -- Their covariance, rows in the order of parameters.
    finished_at TIMESTAMPTZ NOT NULL,
    start_rig_digest VARCHAR,  -- The rig before the calibration.
    stops VARCHAR[],  -- Names of the stops that were used.
    n_spheres INTEGER,  -- Spheres, counted once per stop.
    n_two_faced INTEGER,  -- Spheres with returns on both faces.
    n_returns BIGINT,  -- Returns of the estimate.
    dof INTEGER,  -- Returns minus unknowns.
    sigma0 DOUBLE,  -- Square root of the variance factor; 1 means range noise as usual for a VLP-16.
    residual_rms_before_m DOUBLE,  -- Root mean square residual of the returns with the rig before the calibration, the centres adjusted to it.
    residual_rms_after_m DOUBLE,  -- The same with the estimated rig.
    n_gaps INTEGER,  -- Spheres whose two faces were compared with the estimated rig.
    gap_rms_before_m DOUBLE,  -- Root mean square distance between the centres that the two faces of a sphere give, with the rig before the calibration; NULL where none could be compared.
    gap_rms_after_m DOUBLE,  -- The same with the estimated rig.
    gap_sigma_after_m DOUBLE,  -- Its prediction from the covariances of the centres.
    config JSON,  -- The effective configuration.
    config_digest VARCHAR,  -- First 16 hexadecimal digits of the SHA-256 of the canonical configuration.
    code_version VARCHAR,  -- Version of spheremark.
    duration_s DOUBLE  -- Time from the logs to the numbers.
);

-- Each parameter of a rig before and after a calibration; parameters that the scans do not determine have a reason.
CREATE TABLE calibrated_parameters (
    calibration_id VARCHAR NOT NULL,
    place INTEGER NOT NULL,  -- Index in the covariance, from 0; parameters that are not estimated follow.
    parameter VARCHAR NOT NULL,
    unit VARCHAR NOT NULL,  -- Unit of its numbers; empty where it was not estimated.
    is_estimated BOOLEAN NOT NULL,  -- Whether the scans determine it.
    start_value DOUBLE,  -- Value before the calibration, in the unit of the row.
    estimate DOUBLE,  -- Value after the calibration, in the unit of the row.
    sigma DOUBLE,  -- Its standard deviation, in the unit of the row.
    reason VARCHAR NOT NULL,  -- Why it was not estimated; empty when it was.
    PRIMARY KEY (calibration_id, parameter)
);

-- Difference of the centre of each sphere from the two faces of a scan, front minus back, in the base frame.
CREATE TABLE calibration_gaps (
    calibration_id VARCHAR NOT NULL,
    is_after BOOLEAN NOT NULL,  -- Whether with the estimated rig, or with the rig before.
    stop VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,  -- M01, M02 ... by azimuth, within one stop and rig.
    range_m DOUBLE NOT NULL,  -- From the base to the middle of both centres.
    azimuth_deg DOUBLE NOT NULL,  -- Direction to it, counter-clockwise from x.
    gap_radial_m DOUBLE NOT NULL,  -- Along the line of sight; positive where the front is farther.
    gap_across_m DOUBLE NOT NULL,  -- Horizontally across it, counter-clockwise.
    gap_up_m DOUBLE NOT NULL,  -- Across both, up.
    gap_3d_m DOUBLE NOT NULL,  -- Length of the gap.
    sigma_3d_m DOUBLE NOT NULL  -- Its prediction from the covariances of both centres.
);

-- Adjusted networks.

-- Networks of stations and marks adjusted together.
CREATE TABLE adjustments (
    adjustment_id VARCHAR PRIMARY KEY,  -- The same in every table of its results.
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    n_stations INTEGER NOT NULL,
    n_marks INTEGER NOT NULL,
    dof INTEGER NOT NULL,  -- Observations minus unknowns.
    sigma0 DOUBLE,  -- Square root of the variance factor (a priori 1); NULL without redundancy.
    passes_global_test BOOLEAN NOT NULL,  -- Whether the variance factor agrees with 1.
    finished_at TIMESTAMPTZ NOT NULL,
    status VARCHAR,  -- ok or weak.
    warnings VARCHAR[],  -- Reasons of a weak status, as sentences.
    datum VARCHAR,  -- free (place and heading of the first station) or control.
    datum_text VARCHAR,  -- Origin of position and heading, as a sentence.
    fit_method VARCHAR,  -- Fitting method of the centres.
    n_control_marks INTEGER,  -- Control marks in use.
    n_observations INTEGER,  -- Observed coordinates and angles that were used.
    n_unknowns INTEGER,
    n_left_out INTEGER,  -- Observed centres, levellings and control marks that were not used.
    n_refused INTEGER,  -- Stations that could not be connected to the others.
    vtpv DOUBLE,  -- Weighted sum of squares of the residuals.
    vtpv_limit DOUBLE,  -- Largest sum that passes the global test.
    test_level DOUBLE,  -- Probability with which the tests reject good data.
    w_limit DOUBLE,  -- Limit of w for gross errors.
    variance_factor_centres DOUBLE,  -- Sum of squares over redundancy of the centres; NULL without redundancy.
    variance_factor_gravity DOUBLE,  -- The same of the levelling.
    variance_factor_control DOUBLE,  -- The same of the control marks.
    range_bias_m DOUBLE,  -- Estimated bias of all ranges, positive is too long; NULL where it was no unknown.
    sigma_range_bias_m DOUBLE,  -- Its standard deviation.
    rig_digest VARCHAR,  -- The rig of all its stations; NULL where they differ.
    config JSON,  -- The effective configuration.
    config_digest VARCHAR,  -- First 16 hexadecimal digits of the SHA-256 of the canonical configuration.
    code_version VARCHAR,  -- Version of spheremark.
    duration_s DOUBLE  -- Time from the logs to the numbers.
);

-- Station poses of a network in the site frame, or in the frame of the first station where it is free. Errors exist only against truth; those of a free network after it was laid on the truth (heading and place, over all stations and marks).
CREATE TABLE adjusted_stations (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,  -- Name in the network: that of the stop, numbered where a stop was recorded more than once.
    stop VARCHAR NOT NULL,  -- The stop of the run that its centres are from.
    run_id VARCHAR NOT NULL,  -- The run that its centres are from; with stop, fit_method and marker it leads to marker_fits.
    recording_id VARCHAR NOT NULL,
    rig_digest VARCHAR NOT NULL,  -- The rig of that run.
    x_m DOUBLE NOT NULL,  -- Position of the station.
    y_m DOUBLE NOT NULL,  -- Position of the station.
    z_m DOUBLE NOT NULL,  -- Position of the station, up.
    yaw_deg DOUBLE NOT NULL,  -- Heading of the x axis of the station, counter-clockwise from x.
    rotation DOUBLE[] NOT NULL,  -- R_site_station, nine numbers, rows first.
    cov_xx_m2 DOUBLE NOT NULL,  -- Covariance of the position.
    cov_xy_m2 DOUBLE NOT NULL,
    cov_xz_m2 DOUBLE NOT NULL,
    cov_yy_m2 DOUBLE NOT NULL,
    cov_yz_m2 DOUBLE NOT NULL,
    cov_zz_m2 DOUBLE NOT NULL,
    cov_motion DOUBLE[] NOT NULL,  -- Covariance of a small motion on the left (rotation in rad, translation in m), 36 numbers, rows first.
    sigma_3d_m DOUBLE NOT NULL,  -- Square root of the trace of the covariance of the position.
    sigma_yaw_deg DOUBLE NOT NULL,  -- Standard deviation of the heading.
    ellipse_major_m DOUBLE NOT NULL,  -- Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).
    ellipse_minor_m DOUBLE NOT NULL,  -- Semi-minor axis of the horizontal standard ellipse.
    ellipse_bearing_deg DOUBLE NOT NULL,  -- Bearing of the major axis, clockwise from y, 0 to 180.
    ellipse_major_95_m DOUBLE NOT NULL,  -- Semi-major axis of the horizontal 95 % ellipse.
    ellipse_minor_95_m DOUBLE NOT NULL,  -- Semi-minor axis of the horizontal 95 % ellipse.
    n_observations INTEGER NOT NULL,  -- Centres used for it.
    mean_redundancy DOUBLE,  -- Mean redundancy of those centres, 0 to 3.
    error_x_m DOUBLE,  -- Estimate minus truth along x of the true site frame; NULL without truth.
    error_y_m DOUBLE,  -- Estimate minus truth along y.
    error_z_m DOUBLE,  -- Estimate minus truth along z, up.
    error_yaw_deg DOUBLE,  -- Estimate minus truth of the heading.
    error_3d_m DOUBLE,  -- Length of the error.
    PRIMARY KEY (adjustment_id, station)
);

-- Sphere centres of a network, in the frame of its stations. Errors as those of adjusted_stations, against the true mark nearest to it.
CREATE TABLE adjusted_marks (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,  -- Name of the control mark; M01, M02 ... in a free network, N01, N02 ... for marks beside control.
    is_control BOOLEAN NOT NULL,  -- Whether it was observed as control.
    status VARCHAR NOT NULL,  -- ok or weak.
    reason VARCHAR NOT NULL,  -- Why it is weak; empty when it is not.
    x_m DOUBLE NOT NULL,  -- Centre of the sphere.
    y_m DOUBLE NOT NULL,  -- Centre of the sphere.
    z_m DOUBLE NOT NULL,  -- Centre of the sphere, up.
    cov_xx_m2 DOUBLE NOT NULL,  -- Covariance of the centre.
    cov_xy_m2 DOUBLE NOT NULL,
    cov_xz_m2 DOUBLE NOT NULL,
    cov_yy_m2 DOUBLE NOT NULL,
    cov_yz_m2 DOUBLE NOT NULL,
    cov_zz_m2 DOUBLE NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,  -- Square root of the trace of the covariance.
    ellipse_major_m DOUBLE NOT NULL,  -- Semi-major axis of the horizontal standard ellipse (1 sigma, 39 % of cases).
    ellipse_minor_m DOUBLE NOT NULL,  -- Semi-minor axis of the horizontal standard ellipse.
    ellipse_bearing_deg DOUBLE NOT NULL,  -- Bearing of the major axis, clockwise from y, 0 to 180.
    ellipse_major_95_m DOUBLE NOT NULL,  -- Semi-major axis of the horizontal 95 % ellipse.
    ellipse_minor_95_m DOUBLE NOT NULL,  -- Semi-minor axis of the horizontal 95 % ellipse.
    n_observations INTEGER NOT NULL,  -- Stations that observed it.
    mean_redundancy DOUBLE,  -- Mean redundancy of those observations, 0 to 3.
    error_x_m DOUBLE,  -- Estimate minus truth along x of the true site frame; NULL without truth.
    error_y_m DOUBLE,  -- Estimate minus truth along y.
    error_z_m DOUBLE,  -- Estimate minus truth along z, up.
    error_3d_m DOUBLE,  -- Length of the error.
    PRIMARY KEY (adjustment_id, mark)
);

-- Observations of a network, used or left out: centres, levelling of the stations, control marks; residuals are observed minus computed, along the axes of the network.
CREATE TABLE adjusted_observations (
    adjustment_id VARCHAR NOT NULL,
    kind VARCHAR NOT NULL,  -- centre, gravity or control.
    station VARCHAR,  -- The observing station; NULL for a control mark.
    marker VARCHAR,  -- The observed marker; NULL where it is no centre.
    mark VARCHAR,  -- The mark; NULL where none is known.
    used BOOLEAN NOT NULL,  -- Whether the network uses it.
    reason VARCHAR NOT NULL,  -- Reason of the omission; empty when it is used.
    residual_x_m DOUBLE,  -- Residual of a centre or a control mark; NULL of a marker that is no mark.
    residual_y_m DOUBLE,  -- The same along y.
    residual_z_m DOUBLE,  -- The same along z, up.
    residual_x_deg DOUBLE,  -- Residual of a levelling: of the up direction along x.
    residual_y_deg DOUBLE,  -- The same along y.
    redundancy DOUBLE,  -- Redundancy of its coordinates together: of 3, of levelling of 2.
    w DOUBLE,  -- Largest w-statistic of its coordinates; NULL where not testable or not used.
    minimal_detectable_bias_m DOUBLE,  -- Smallest bias that the w-test would find with the power of the configuration; NULL where none is.
    minimal_detectable_bias_deg DOUBLE,  -- The same of a levelling.
    external_reliability_station_m DOUBLE,  -- Shift of the station by an undetected bias of that size.
    external_reliability_mark_m DOUBLE  -- Shift of the mark by an undetected bias of that size.
);

-- Stations and logs that are not part of a network, with the reason.
CREATE TABLE refused_stations (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,  -- Name of the stop, or of a log without stops.
    code VARCHAR NOT NULL,  -- Stable code of the error, for programs.
    reason VARCHAR NOT NULL  -- The reason, as a sentence.
);

-- Each control mark left out in turn: its position from the network without its coordinates, minus the given one. No error against truth: both have sigmas. A mark that the others do not determine has no row.
CREATE TABLE control_checks (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    n_observations INTEGER NOT NULL,  -- Stations that observed it.
    difference_x_m DOUBLE NOT NULL,  -- Predicted minus given along x of the site frame.
    difference_y_m DOUBLE NOT NULL,  -- Predicted minus given along y of the site frame.
    difference_z_m DOUBLE NOT NULL,  -- Predicted minus given along z of the site frame, up.
    difference_3d_m DOUBLE NOT NULL,  -- Length of the difference.
    sigma_x_m DOUBLE NOT NULL,  -- Standard deviation of that difference, prediction and given mark together.
    sigma_y_m DOUBLE NOT NULL,
    sigma_z_m DOUBLE NOT NULL,
    sigma_3d_m DOUBLE NOT NULL,  -- Square root of the trace of the covariance of the difference.
    PRIMARY KEY (adjustment_id, mark)
);

-- Stations of a network at one position: their centres after a rigid motion. No error against truth: errors that both share do not show.
CREATE TABLE repeated_stops (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    again VARCHAR NOT NULL,  -- The second station.
    n_marks INTEGER NOT NULL,  -- Marks that both observed.
    apart_x_m DOUBLE NOT NULL,  -- Position of the second station minus the first, along x.
    apart_y_m DOUBLE NOT NULL,  -- The same along y.
    apart_z_m DOUBLE NOT NULL,  -- The same along z, up.
    apart_3d_m DOUBLE NOT NULL,  -- Distance of the two stations.
    difference_rms_m DOUBLE NOT NULL,  -- Root mean square 3-D difference of their centres after a rigid motion.
    predicted_rms_m DOUBLE NOT NULL,  -- Its prediction from the covariances of the centres.
    PRIMARY KEY (adjustment_id, station, again)
);

-- Plans of marker placements: predictions are stored; the view placements reads the achieved
-- accuracy from the newest results of the survey.

-- Elevation models and clouds that were uploaded to plan on.
CREATE TABLE terrains (
    terrain_id VARCHAR PRIMARY KEY,  -- SHA-256 of the bytes of the file.
    name VARCHAR NOT NULL,  -- Name of the uploaded file.
    size_bytes BIGINT NOT NULL,  -- Length of the file.
    url VARCHAR NOT NULL,  -- Location of the file.
    uploaded_at TIMESTAMPTZ NOT NULL  -- Instant of the upload (UTC).
);

-- Stored arrangements of marks.
CREATE TABLE plans (
    placement_id VARCHAR PRIMARY KEY,  -- Given by the catalogue; the same in planned_stops and placements.
    name VARCHAR NOT NULL,  -- Name of the user.
    survey_id VARCHAR,  -- Survey of the plan; NULL without one.
    site_name VARCHAR NOT NULL,  -- Terrain of the plan.
    resection_method VARCHAR NOT NULL,  -- free_station, or paper (three circles).
    tolerance_m DOUBLE NOT NULL,  -- 3-D error that was accepted.
    marks JSON NOT NULL,  -- The arrangement: names, centres in the site frame [m] and heights of poles [m].
    n_marks INTEGER NOT NULL,  -- Number of marks.
    model_version VARCHAR NOT NULL,  -- Digest of the model of centres behind the prediction.
    model_source VARCHAR NOT NULL,  -- sensor, or fitted (from the marker_fits of own surveys).
    request JSON NOT NULL,  -- The complete request.
    created_at TIMESTAMPTZ NOT NULL  -- Instant of storage (UTC).
);

-- Predictions of a stored plan at each of its stops.
CREATE TABLE planned_stops (
    placement_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    place INTEGER NOT NULL,  -- Its place in the plan, from 0.
    x_m DOUBLE NOT NULL,  -- Planned place of the LiDAR in the site frame.
    y_m DOUBLE NOT NULL,  -- Planned place of the LiDAR in the site frame.
    z_m DOUBLE NOT NULL,  -- Planned place of the LiDAR in the site frame, up.
    n_seen INTEGER NOT NULL,  -- Marks that can be found from there.
    n_used INTEGER NOT NULL,  -- Marks used for the position.
    sigma_3d_m DOUBLE,  -- Predicted: square root of the trace of the covariance of the position; NULL where there is none.
    probability_within_tolerance DOUBLE NOT NULL,  -- Predicted probability that the 3-D error is within the tolerance, 0 to 1.
    included_angle_min_deg DOUBLE,  -- Least angle between two used marks.
    included_angle_max_deg DOUBLE,  -- Greatest angle between two used marks.
    dop DOUBLE,  -- Dilution of precision; NULL where there is no position.
    reason VARCHAR NOT NULL,  -- Reason of a missing or weak position; else empty.
    PRIMARY KEY (placement_id, stop)
);

-- Files: products of all stops of a survey, and documents of one result.

-- Files made of all stops of a survey: clouds in the site frame and elevation models.
CREATE TABLE site_products (
    product_id VARCHAR NOT NULL,  -- The same for all files of one job.
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    kind VARCHAR NOT NULL,  -- laz, e57 or geotiff.
    url VARCHAR NOT NULL,  -- Location of the file.
    sha256 VARCHAR NOT NULL,  -- Digest of its bytes.
    size_bytes BIGINT NOT NULL,  -- Length of the file.
    n_points BIGINT NOT NULL,  -- Returns of the cloud, or of the heights.
    n_stations INTEGER NOT NULL,  -- Stations whose returns are in it.
    poses VARCHAR NOT NULL,  -- Origin of the poses: control or free (an adjustment), or fixes (each station alone).
    adjustment_id VARCHAR,  -- The adjustment that the poses are from; NULL where each station was positioned alone.
    min_x_m DOUBLE NOT NULL,  -- Least coordinate in the site frame.
    min_y_m DOUBLE NOT NULL,  -- Least coordinate in the site frame.
    min_z_m DOUBLE NOT NULL,  -- Least coordinate in the site frame, up.
    max_x_m DOUBLE NOT NULL,  -- Greatest coordinate in the site frame.
    max_y_m DOUBLE NOT NULL,  -- Greatest coordinate in the site frame.
    max_z_m DOUBLE NOT NULL,  -- Greatest coordinate in the site frame, up.
    cell_m DOUBLE,  -- Edge of a cell of an elevation model.
    share_known DOUBLE,  -- Share of its cells with observed ground.
    sigma_median_m DOUBLE,  -- Median of the standard deviations of its heights.
    config_digest VARCHAR NOT NULL,
    code_version VARCHAR NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    PRIMARY KEY (product_id, kind)
);

-- Files that a result can be downloaded as.
CREATE TABLE documents (
    result_id VARCHAR NOT NULL,  -- adjustment_id or calibration_id.
    name VARCHAR NOT NULL,  -- Name of the file.
    media_type VARCHAR NOT NULL,
    text VARCHAR NOT NULL,  -- The file itself.
    PRIMARY KEY (result_id, name)
);

-- Surveys that were deleted; they can be restored.
CREATE TABLE deleted_surveys (
    survey_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,  -- Its name before the deletion; it is free for another survey.
    deleted_at TIMESTAMPTZ NOT NULL  -- Instant of the deletion (UTC).
);

-- Logs that were taken out of a survey, with their results; they can be put back.
CREATE TABLE removed_recordings (
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    removed_at TIMESTAMPTZ NOT NULL,  -- Instant of the removal (UTC).
    PRIMARY KEY (survey_id, recording_id)
);

-- Instant at which the control marks of a survey were set; results before it do not know them.
CREATE TABLE control_changes (
    survey_id VARCHAR PRIMARY KEY,
    changed_at TIMESTAMPTZ NOT NULL  -- Instant of the newest change (UTC).
);

-- Queries that were kept under a name, to be shared by their address.
CREATE TABLE saved_queries (
    name VARCHAR PRIMARY KEY,  -- Name in the address.
    sql VARCHAR NOT NULL,  -- One SELECT; $name stands for a parameter.
    parameters JSON NOT NULL,  -- Values of its parameters where an address gives none.
    changed_at TIMESTAMPTZ NOT NULL  -- Instant of the last change (UTC).
);

-- Views: the newest results, and their accuracy.

-- The newest run of each recording in each survey, without what was deleted.
CREATE VIEW latest_runs AS
SELECT r.* FROM runs AS r
WHERE r.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
    AND NOT EXISTS (SELECT 1 FROM removed_recordings AS x
        WHERE x.survey_id = r.survey_id AND x.recording_id = r.recording_id)
QUALIFY row_number() OVER (PARTITION BY survey_id, recording_id ORDER BY finished_at DESC) = 1;

-- marker_fits of the newest run of each recording, with the survey.
CREATE VIEW latest_marker_fits AS
SELECT r.survey_id, s.name AS survey, r.recording_id, m.*
FROM marker_fits AS m JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);

-- station_fixes of the newest run of each recording, with the survey.
CREATE VIEW latest_station_fixes AS
SELECT r.survey_id, s.name AS survey, r.recording_id, f.*
FROM station_fixes AS f JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);

-- The newest calibration of each survey.
CREATE VIEW latest_calibrations AS
SELECT s.name AS survey, c.* FROM calibrations AS c JOIN surveys AS s USING (survey_id)
WHERE c.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
QUALIFY row_number() OVER (PARTITION BY c.survey_id ORDER BY c.finished_at DESC) = 1;

-- The newest free and the newest controlled adjustment of each survey.
CREATE VIEW latest_adjustments AS
SELECT s.name AS survey, a.* FROM adjustments AS a JOIN surveys AS s USING (survey_id)
WHERE a.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
QUALIFY row_number() OVER (PARTITION BY a.survey_id, a.datum ORDER BY a.finished_at DESC) = 1;

-- adjusted_stations of the newest free and the newest controlled adjustment of each survey.
CREATE VIEW latest_adjusted_stations AS
SELECT a.survey_id, a.survey, a.datum, x.*
FROM adjusted_stations AS x JOIN latest_adjustments AS a USING (adjustment_id);

-- adjusted_marks of the newest free and the newest controlled adjustment of each survey.
CREATE VIEW latest_adjusted_marks AS
SELECT a.survey_id, a.survey, a.datum, x.*
FROM adjusted_marks AS x JOIN latest_adjustments AS a USING (adjustment_id);

-- The one solution of each survey that pages, plots and exports show: the newest network with control, else stations positioned one by one, else the newest free network.
CREATE VIEW chosen_solutions AS
SELECT survey_id, survey,
    solution,  -- network with control, single stations, or free network (in the frame of its first station).
    adjustment_id,  -- The adjustment; NULL for single stations.
    fit_method,  -- Fitting method of the centres.
    resection_method,  -- Method of positioning; NULL for a network.
    finished_at  -- Instant of its newest result (UTC).
FROM (
    SELECT survey_id, survey, 'network with control' AS solution, adjustment_id, fit_method,
        NULL::VARCHAR AS resection_method, finished_at, 0 AS place
    FROM latest_adjustments WHERE datum <> 'free'
    UNION ALL
    SELECT f.survey_id, f.survey, 'single stations', NULL, f.fit_method, f.resection_method,
        max(r.finished_at), 1
    FROM latest_station_fixes AS f JOIN runs AS r USING (run_id)
    WHERE f.x_m IS NOT NULL GROUP BY ALL
    UNION ALL
    SELECT survey_id, survey, 'free network', adjustment_id, fit_method, NULL, finished_at, 2
    FROM latest_adjustments WHERE datum = 'free'
)
QUALIFY row_number() OVER (
    PARTITION BY survey_id
    ORDER BY place, fit_method <> 'along_beam', resection_method <> 'free_station', fit_method
) = 1;

-- The stations of the chosen solution of each survey, one row each.
CREATE VIEW chosen_stations AS
SELECT c.survey_id, c.survey, c.solution, c.adjustment_id, c.fit_method, c.resection_method,
    x.station,  -- Name of the station: that of the stop, numbered where a stop was recorded more than once.
    x.stop, x.recording_id, x.run_id,
    'ok' AS status,  -- ok, weak or failed; of a network as a whole in adjustments.
    '' AS reason,  -- Why it is weak or failed.
    x.x_m, x.y_m, x.z_m, x.yaw_deg, x.rotation,
    x.cov_xx_m2, x.cov_xy_m2, x.cov_xz_m2, x.cov_yy_m2, x.cov_yz_m2, x.cov_zz_m2, x.cov_motion,
    x.sigma_3d_m, x.sigma_yaw_deg, x.ellipse_major_95_m, x.ellipse_minor_95_m,
    x.ellipse_bearing_deg,
    x.n_observations AS n_markers,  -- Centres that were used for it.
    a.dof,  -- Degrees of freedom; of a network those of the whole.
    a.sigma0,  -- Square root of the variance factor; of a network that of the whole.
    a.passes_global_test,  -- Whether the variance factor agrees with 1.
    x.rig_digest, x.error_x_m, x.error_y_m, x.error_z_m, x.error_3d_m
FROM chosen_solutions AS c JOIN adjusted_stations AS x USING (adjustment_id)
JOIN adjustments AS a USING (adjustment_id)
UNION ALL
SELECT c.survey_id, c.survey, c.solution, c.adjustment_id, c.fit_method, c.resection_method,
    f.stop, f.stop, f.recording_id, f.run_id, f.status, f.reason,
    f.x_m, f.y_m, f.z_m, f.yaw_deg, f.rotation,
    f.cov_xx_m2, f.cov_xy_m2, f.cov_xz_m2, f.cov_yy_m2, f.cov_yz_m2, f.cov_zz_m2, f.cov_motion,
    f.sigma_3d_m, f.sigma_yaw_deg, f.ellipse_major_95_m, f.ellipse_minor_95_m,
    f.ellipse_bearing_deg, f.n_markers, f.dof, f.sigma0, f.passes_global_test, r.rig_digest,
    f.error_x_m, f.error_y_m, f.error_z_m, f.error_3d_m
FROM chosen_solutions AS c
JOIN latest_station_fixes AS f
    ON f.survey_id = c.survey_id AND f.fit_method = c.fit_method
    AND f.resection_method = c.resection_method
JOIN runs AS r ON r.run_id = f.run_id
WHERE c.adjustment_id IS NULL AND f.x_m IS NOT NULL;

-- Errors of sphere centres in bins of 1 m of distance, newest runs.
CREATE VIEW accuracy_by_distance AS
SELECT survey_id, survey, fit_method,
    floor(range_m) AS range_from_m,  -- Lower end of the bin, included.
    floor(range_m) + 1 AS range_to_m,  -- Upper end of the bin, excluded.
    count(*) AS n_fits,  -- Fits in the bin.
    count(error_3d_m) AS n_errors,  -- Fits whose error is known.
    avg(n_points) AS mean_n_points,  -- Mean number of returns of a fit.
    sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m,  -- Predicted: root mean square of sigma_3d_m.
    avg(error_3d_m) AS error_3d_mean_m,  -- Mean error; the study publishes this one.
    sqrt(avg(error_3d_m ^ 2)) AS error_3d_rms_m,  -- Root mean square error.
    quantile_cont(error_3d_m, 0.95) AS error_3d_p95_m,  -- 95th percentile of the error; the tolerance holds when it is at most that.
    max(error_3d_m) AS error_3d_max_m,  -- Largest error.
    avg(error_radial_m) AS error_radial_mean_m  -- Mean error along the line of sight; positive is too far.
FROM latest_marker_fits GROUP BY ALL ORDER BY ALL;

-- Errors of sphere centres in bins of 20 returns, newest runs.
CREATE VIEW accuracy_by_point_count AS
SELECT survey_id, survey, fit_method,
    20 * (n_points // 20) AS n_points_from,  -- Lower end of the bin, included.
    20 * (n_points // 20) + 20 AS n_points_to,  -- Upper end of the bin, excluded.
    count(*) AS n_fits,  -- Fits in the bin.
    count(error_3d_m) AS n_errors,  -- Fits whose error is known.
    avg(range_m) AS mean_range_m,  -- Mean distance of the fits.
    sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m,  -- Predicted: root mean square of sigma_3d_m.
    avg(error_3d_m) AS error_3d_mean_m,  -- Mean error; the study publishes this one.
    sqrt(avg(error_3d_m ^ 2)) AS error_3d_rms_m,  -- Root mean square error.
    quantile_cont(error_3d_m, 0.95) AS error_3d_p95_m,  -- 95th percentile of the error; the tolerance holds when it is at most that.
    max(error_3d_m) AS error_3d_max_m  -- Largest error.
FROM latest_marker_fits GROUP BY ALL ORDER BY ALL;

-- Errors of stations positioned from pairs and triples of marks in bins of 10 degrees of included angle (of triples the largest), newest runs.
CREATE VIEW accuracy_by_included_angle AS
SELECT r.survey_id, s.name AS survey, x.fit_method, x.resection_method,
    x.n_marks,  -- Marks per position; 2 for pairs, 3 for triples.
    10 * floor(x.included_angle_max_deg / 10) AS included_angle_from_deg,  -- Lower end of the bin, included.
    10 * floor(x.included_angle_max_deg / 10) + 10 AS included_angle_to_deg,  -- Upper end of the bin, excluded.
    count(*) AS n_resections,  -- Positions in the bin.
    count(x.error_3d_m) AS n_errors,  -- Positions whose error is known.
    sqrt(avg(x.sigma_horizontal_m ^ 2)) AS sigma_horizontal_rms_m,  -- Predicted: root mean square of sigma_horizontal_m.
    sqrt(avg(x.sigma_3d_m ^ 2)) AS sigma_3d_rms_m,  -- Predicted: root mean square of sigma_3d_m.
    sqrt(avg(x.error_horizontal_m ^ 2)) AS error_horizontal_rms_m,  -- Root mean square error in the plane.
    avg(x.error_3d_m) AS error_3d_mean_m,  -- Mean error; the study publishes this one.
    sqrt(avg(x.error_3d_m ^ 2)) AS error_3d_rms_m,  -- Root mean square error.
    quantile_cont(x.error_3d_m, 0.95) AS error_3d_p95_m,  -- 95th percentile of the error; the tolerance holds when it is at most that.
    max(x.error_3d_m) AS error_3d_max_m  -- Largest error.
FROM resections AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
GROUP BY ALL ORDER BY ALL;

-- Mean error of the sphere centres and error of the station per stop, newest runs.
CREATE VIEW accuracy_by_stop AS
SELECT m.survey_id, m.survey, m.stop, m.fit_method,
    m.n_fits,  -- Markers of the stop.
    m.mean_range_m,  -- Mean distance of its markers.
    m.error_3d_mean_m AS marker_error_3d_mean_m,  -- Mean error of its sphere centres.
    m.error_3d_max_m AS marker_error_3d_max_m,  -- Largest error of its sphere centres.
    m.sigma_3d_rms_m AS marker_sigma_3d_rms_m,  -- Predicted: root mean square of sigma_3d_m of its centres.
    f.resection_method,
    f.status,  -- Status of the station: ok, weak or failed.
    f.n_markers,  -- Markers used for the station.
    f.sigma_3d_m AS station_sigma_3d_m,  -- Predicted error of the station.
    f.error_3d_m AS station_error_3d_m  -- Error of the station.
FROM (
    SELECT survey_id, survey, recording_id, stop, fit_method, count(*) AS n_fits,
        avg(range_m) AS mean_range_m, avg(error_3d_m) AS error_3d_mean_m,
        max(error_3d_m) AS error_3d_max_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_3d_rms_m
    FROM latest_marker_fits GROUP BY ALL
) AS m
LEFT JOIN latest_station_fixes AS f USING (survey_id, recording_id, stop, fit_method)
ORDER BY m.survey, m.stop, m.fit_method;

-- Prediction of a stored plan per stop and, once a stop of that name is surveyed, the result.
CREATE VIEW placements AS
SELECT p.placement_id, p.name, p.survey_id, s.name AS survey, p.site_name, p.marks, p.n_marks,
    p.model_version, p.model_source, p.resection_method, p.tolerance_m, x.stop, x.n_seen, x.n_used,
    x.sigma_3d_m, x.probability_within_tolerance, x.included_angle_min_deg,
    x.included_angle_max_deg, x.dop, x.reason,
    f.run_id,  -- Run that surveyed the stop; NULL until then.
    f.n_markers,  -- Markers used for the position once surveyed.
    f.sigma_3d_m AS achieved_sigma_3d_m,  -- Sigma of the position once surveyed.
    f.error_3d_m,  -- Error of the position once surveyed; NULL without truth.
    f.error_3d_m <= p.tolerance_m AS is_within_tolerance,  -- Whether that error is within the tolerance.
    p.created_at
FROM plans AS p JOIN planned_stops AS x USING (placement_id)
LEFT JOIN surveys AS s USING (survey_id)
LEFT JOIN latest_station_fixes AS f ON f.survey_id = p.survey_id AND f.stop = x.stop
    AND f.fit_method = 'along_beam' AND f.resection_method = p.resection_method
ORDER BY p.created_at DESC, p.placement_id, x.place;
