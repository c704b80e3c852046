-- Jobs of several kinds: over several logs, with a rig of their own, with options of the kind.

ALTER TABLE jobs ADD COLUMN options JSON DEFAULT '{}';
COMMENT ON COLUMN jobs.options IS 'What was chosen beside the configuration: rig (a digest), recordings (where the job reads several), and what its kind lets one choose.';

ALTER TABLE surveys ADD COLUMN rig_digest VARCHAR;
COMMENT ON COLUMN surveys.rig_digest IS 'Rig that its jobs use where they name none; NULL: the one that each log describes.';

COMMENT ON TABLE rigs IS 'Every rig that a run used, that a calibration gave or that somebody entered, as JSON.';

-- Adjustments

ALTER TABLE adjustments ALTER COLUMN sigma0 DROP NOT NULL;
ALTER TABLE adjustments ADD COLUMN status VARCHAR;
ALTER TABLE adjustments ADD COLUMN warnings VARCHAR[];
ALTER TABLE adjustments ADD COLUMN datum VARCHAR;
ALTER TABLE adjustments ADD COLUMN datum_text VARCHAR;
ALTER TABLE adjustments ADD COLUMN fit_method VARCHAR;
ALTER TABLE adjustments ADD COLUMN n_control_marks INTEGER;
ALTER TABLE adjustments ADD COLUMN n_observations INTEGER;
ALTER TABLE adjustments ADD COLUMN n_unknowns INTEGER;
ALTER TABLE adjustments ADD COLUMN n_left_out INTEGER;
ALTER TABLE adjustments ADD COLUMN n_refused INTEGER;
ALTER TABLE adjustments ADD COLUMN vtpv DOUBLE;
ALTER TABLE adjustments ADD COLUMN vtpv_limit DOUBLE;
ALTER TABLE adjustments ADD COLUMN test_level DOUBLE;
ALTER TABLE adjustments ADD COLUMN w_limit DOUBLE;
ALTER TABLE adjustments ADD COLUMN variance_factor_centres DOUBLE;
ALTER TABLE adjustments ADD COLUMN variance_factor_gravity DOUBLE;
ALTER TABLE adjustments ADD COLUMN variance_factor_control DOUBLE;
ALTER TABLE adjustments ADD COLUMN range_bias_m DOUBLE;
ALTER TABLE adjustments ADD COLUMN sigma_range_bias_m DOUBLE;
ALTER TABLE adjustments ADD COLUMN rig_digest VARCHAR;
ALTER TABLE adjustments ADD COLUMN config JSON;
ALTER TABLE adjustments ADD COLUMN config_digest VARCHAR;
ALTER TABLE adjustments ADD COLUMN code_version VARCHAR;
ALTER TABLE adjustments ADD COLUMN duration_s DOUBLE;
COMMENT ON COLUMN adjustments.adjustment_id IS 'The same in every table of its results.';
COMMENT ON COLUMN adjustments.sigma0 IS 'Square root of the variance factor (a priori 1); NULL without redundancy.';
COMMENT ON COLUMN adjustments.status IS 'ok or weak.';
COMMENT ON COLUMN adjustments.warnings IS 'Why it is weak, for people.';
COMMENT ON COLUMN adjustments.datum IS 'free (place and heading of the first station) or control.';
COMMENT ON COLUMN adjustments.datum_text IS 'What place and heading rest on, for people.';
COMMENT ON COLUMN adjustments.fit_method IS 'Fitting method of the centres.';
COMMENT ON COLUMN adjustments.n_control_marks IS 'Control marks that it rests on.';
COMMENT ON COLUMN adjustments.n_observations IS 'Observed coordinates and angles that were used.';
COMMENT ON COLUMN adjustments.n_left_out IS 'Observed centres, levellings and control marks that were not used.';
COMMENT ON COLUMN adjustments.n_refused IS 'Stations that could not be tied to the others.';
COMMENT ON COLUMN adjustments.vtpv IS 'Weighted sum of squares of the residuals.';
COMMENT ON COLUMN adjustments.vtpv_limit IS 'Largest sum that passes the global test.';
COMMENT ON COLUMN adjustments.test_level IS 'Probability with which the tests reject good data.';
COMMENT ON COLUMN adjustments.w_limit IS 'Largest w that is no gross error.';
COMMENT ON COLUMN adjustments.variance_factor_centres IS 'Sum of squares over redundancy of the centres; NULL without redundancy.';
COMMENT ON COLUMN adjustments.variance_factor_gravity IS 'The same of the levelling.';
COMMENT ON COLUMN adjustments.variance_factor_control IS 'The same of the control marks.';
COMMENT ON COLUMN adjustments.range_bias_m IS 'What all ranges are too long, as estimated; NULL where it was no unknown.';
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
COMMENT ON COLUMN adjusted_stations.n_observations IS 'Centres that carry it.';
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
COMMENT ON TABLE adjusted_observations IS 'What a network rests on, and what it left out: observed centres, levelling of the stations, control marks; residuals are observed minus computed, along the axes of the network.';
COMMENT ON COLUMN adjusted_observations.kind IS 'centre, gravity or control.';
COMMENT ON COLUMN adjusted_observations.station IS 'Who observed it; NULL for a control mark.';
COMMENT ON COLUMN adjusted_observations.marker IS 'Which of its markers; NULL where it is no centre.';
COMMENT ON COLUMN adjusted_observations.mark IS 'Which mark it is; NULL where none is known.';
COMMENT ON COLUMN adjusted_observations.used IS 'Whether it carries the network.';
COMMENT ON COLUMN adjusted_observations.reason IS 'Why it does not; empty when it does.';
COMMENT ON COLUMN adjusted_observations.residual_x_m IS 'Residual of a centre or a control mark; NULL of a marker that is no mark.';
COMMENT ON COLUMN adjusted_observations.residual_y_m IS 'The same along y.';
COMMENT ON COLUMN adjusted_observations.residual_z_m IS 'The same along z, up.';
COMMENT ON COLUMN adjusted_observations.residual_x_deg IS 'Residual of a levelling: of the up direction along x.';
COMMENT ON COLUMN adjusted_observations.residual_y_deg IS 'The same along y.';
COMMENT ON COLUMN adjusted_observations.redundancy IS 'Redundancy of its coordinates together: of 3, of levelling of 2.';
COMMENT ON COLUMN adjusted_observations.w IS 'Largest w-statistic of its coordinates; NULL where not testable or not used.';
COMMENT ON COLUMN adjusted_observations.minimal_detectable_bias_m IS 'Smallest bias that the w-test would find with the power of the configuration; NULL where none is.';
COMMENT ON COLUMN adjusted_observations.minimal_detectable_bias_deg IS 'The same of a levelling.';
COMMENT ON COLUMN adjusted_observations.external_reliability_station_m IS 'Shift of the station by a bias of that size, unseen.';
COMMENT ON COLUMN adjusted_observations.external_reliability_mark_m IS 'Shift of the mark by a bias of that size, unseen.';

CREATE TABLE refused_stations (
    adjustment_id VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    code VARCHAR NOT NULL,
    reason VARCHAR NOT NULL
);
COMMENT ON TABLE refused_stations IS 'Stations and logs that a network does without, and why.';
COMMENT ON COLUMN refused_stations.station IS 'Name of the stop, or of the log where it gave none.';
COMMENT ON COLUMN refused_stations.code IS 'Stable code of the error, for programs.';
COMMENT ON COLUMN refused_stations.reason IS 'Why, for people.';

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
COMMENT ON TABLE control_checks IS 'Each control mark left out in turn: where the network puts it without its coordinates, minus what was given. No error against truth: both have sigmas. A mark that nothing else tells has no row.';
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
COMMENT ON TABLE repeated_stops IS 'Stations of a network that stand at one place: their centres laid on each other. No error against truth: what both have in common does not show.';
COMMENT ON COLUMN repeated_stops.again IS 'The station that stands beside it.';
COMMENT ON COLUMN repeated_stops.n_marks IS 'Marks that both saw.';
COMMENT ON COLUMN repeated_stops.apart_x_m IS 'How far the second stands from the first, along x.';
COMMENT ON COLUMN repeated_stops.apart_y_m IS 'The same along y.';
COMMENT ON COLUMN repeated_stops.apart_z_m IS 'The same along z, up.';
COMMENT ON COLUMN repeated_stops.apart_3d_m IS 'How far apart they stand.';
COMMENT ON COLUMN repeated_stops.difference_rms_m IS 'Root mean square 3-D difference of their centres after a rigid motion.';
COMMENT ON COLUMN repeated_stops.predicted_rms_m IS 'What the covariances of the centres promise.';

-- Calibrations

ALTER TABLE calibrations ADD COLUMN start_rig_digest VARCHAR;
ALTER TABLE calibrations ADD COLUMN stops VARCHAR[];
ALTER TABLE calibrations ADD COLUMN n_spheres INTEGER;
ALTER TABLE calibrations ADD COLUMN n_two_faced INTEGER;
ALTER TABLE calibrations ADD COLUMN n_returns BIGINT;
ALTER TABLE calibrations ADD COLUMN dof INTEGER;
ALTER TABLE calibrations ADD COLUMN sigma0 DOUBLE;
ALTER TABLE calibrations ADD COLUMN residual_rms_before_m DOUBLE;
ALTER TABLE calibrations ADD COLUMN residual_rms_after_m DOUBLE;
ALTER TABLE calibrations ADD COLUMN n_gaps INTEGER;
ALTER TABLE calibrations ADD COLUMN gap_rms_before_m DOUBLE;
ALTER TABLE calibrations ADD COLUMN gap_rms_after_m DOUBLE;
ALTER TABLE calibrations ADD COLUMN gap_sigma_after_m DOUBLE;
ALTER TABLE calibrations ADD COLUMN config JSON;
ALTER TABLE calibrations ADD COLUMN config_digest VARCHAR;
ALTER TABLE calibrations ADD COLUMN code_version VARCHAR;
ALTER TABLE calibrations ADD COLUMN duration_s DOUBLE;
COMMENT ON COLUMN calibrations.calibration_id IS 'The same in every table of its results.';
COMMENT ON COLUMN calibrations.start_rig_digest IS 'The rig that it began with.';
COMMENT ON COLUMN calibrations.stops IS 'Names of the stops that were used.';
COMMENT ON COLUMN calibrations.n_spheres IS 'Spheres, each counted at every stop that saw it.';
COMMENT ON COLUMN calibrations.n_two_faced IS 'Those of them that were seen on both faces.';
COMMENT ON COLUMN calibrations.n_returns IS 'Returns that the estimate rests on.';
COMMENT ON COLUMN calibrations.dof IS 'Returns minus unknowns.';
COMMENT ON COLUMN calibrations.sigma0 IS 'Square root of the variance factor; 1 means that ranges are as noisy as a VLP-16 usually has them.';
COMMENT ON COLUMN calibrations.residual_rms_before_m IS 'Root mean square residual of the returns with the rig that it began with, the centres adjusted to it.';
COMMENT ON COLUMN calibrations.residual_rms_after_m IS 'The same with the estimated rig.';
COMMENT ON COLUMN calibrations.n_gaps IS 'Spheres whose two faces were compared with the estimated rig.';
COMMENT ON COLUMN calibrations.gap_rms_before_m IS 'Root mean square distance between the centres that the two faces of a sphere give, with the rig that it began with; NULL where none could be compared.';
COMMENT ON COLUMN calibrations.gap_rms_after_m IS 'The same with the estimated rig.';
COMMENT ON COLUMN calibrations.gap_sigma_after_m IS 'What it should be by the covariances of the centres.';
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
COMMENT ON TABLE calibrated_parameters IS 'Each parameter of a rig before and after a calibration; and those that the scans do not tell, with the reason.';
COMMENT ON COLUMN calibrated_parameters.place IS 'Its place in the covariance, from 0; what is not estimated follows.';
COMMENT ON COLUMN calibrated_parameters.unit IS 'Unit of its numbers; empty where it was not estimated.';
COMMENT ON COLUMN calibrated_parameters.is_estimated IS 'Whether the scans tell it.';
COMMENT ON COLUMN calibrated_parameters.start_value IS 'Value in the rig that it began with, in the unit of the row.';
COMMENT ON COLUMN calibrated_parameters.estimate IS 'Value in the resulting rig, in the unit of the row.';
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
COMMENT ON TABLE calibration_gaps IS 'How far apart the two faces of a scan put the centre of each sphere, front minus back, in the base frame.';
COMMENT ON COLUMN calibration_gaps.is_after IS 'Whether with the estimated rig, or with the one that the calibration began with.';
COMMENT ON COLUMN calibration_gaps.marker IS 'M01, M02 ... by azimuth, within one stop and rig.';
COMMENT ON COLUMN calibration_gaps.range_m IS 'From the base to the middle of both centres.';
COMMENT ON COLUMN calibration_gaps.azimuth_deg IS 'Direction to it, counter-clockwise from x.';
COMMENT ON COLUMN calibration_gaps.gap_radial_m IS 'Along the line of sight; positive where the front is farther.';
COMMENT ON COLUMN calibration_gaps.gap_across_m IS 'Horizontally across it, counter-clockwise.';
COMMENT ON COLUMN calibration_gaps.gap_up_m IS 'Across both, up.';
COMMENT ON COLUMN calibration_gaps.gap_3d_m IS 'Length of the gap.';
COMMENT ON COLUMN calibration_gaps.sigma_3d_m IS 'What it should be by the covariances of both centres.';

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

-- Views

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

CREATE VIEW latest_calibrations AS
SELECT s.name AS survey, c.* FROM calibrations AS c JOIN surveys AS s USING (survey_id)
QUALIFY row_number() OVER (PARTITION BY c.survey_id ORDER BY c.finished_at DESC) = 1;
COMMENT ON VIEW latest_calibrations IS 'The newest calibration of each survey.';
