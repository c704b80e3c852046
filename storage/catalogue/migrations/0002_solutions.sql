-- What a survey shows: the solution that was chosen, and nothing that was deleted.

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

DROP VIEW latest_runs;

-- The newest run of each recording in each survey, without what was deleted.
CREATE VIEW latest_runs AS
SELECT r.* FROM runs AS r
WHERE r.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
    AND NOT EXISTS (SELECT 1 FROM removed_recordings AS x
        WHERE x.survey_id = r.survey_id AND x.recording_id = r.recording_id)
QUALIFY row_number() OVER (PARTITION BY survey_id, recording_id ORDER BY finished_at DESC) = 1;

DROP VIEW latest_calibrations;

-- The newest calibration of each survey.
CREATE VIEW latest_calibrations AS
SELECT s.name AS survey, c.* FROM calibrations AS c JOIN surveys AS s USING (survey_id)
WHERE c.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
QUALIFY row_number() OVER (PARTITION BY c.survey_id ORDER BY c.finished_at DESC) = 1;

DROP VIEW latest_adjustments;

-- The newest free and the newest controlled adjustment of each survey.
CREATE VIEW latest_adjustments AS
SELECT s.name AS survey, a.* FROM adjustments AS a JOIN surveys AS s USING (survey_id)
WHERE a.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
QUALIFY row_number() OVER (PARTITION BY a.survey_id, a.datum ORDER BY a.finished_at DESC) = 1;

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
