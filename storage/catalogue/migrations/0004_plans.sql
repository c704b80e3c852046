-- Plans of where markers shall stand. What a plan promised is kept as it was; what came of it is
-- read from the newest results of its survey, so that placements always shows both.

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
COMMENT ON COLUMN terrains.url IS 'Where the bytes are.';
COMMENT ON COLUMN terrains.uploaded_at IS 'When it came (UTC).';

DROP TABLE placements;

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
COMMENT ON TABLE plans IS 'Arrangements of marks that were kept, and for what.';
COMMENT ON COLUMN plans.placement_id IS 'Given by the catalogue; the same in planned_stops and placements.';
COMMENT ON COLUMN plans.name IS 'Given by people.';
COMMENT ON COLUMN plans.survey_id IS 'Survey that it was made for; NULL when for none yet.';
COMMENT ON COLUMN plans.site_name IS 'Terrain on which it was made.';
COMMENT ON COLUMN plans.resection_method IS 'free_station, or paper (three circles).';
COMMENT ON COLUMN plans.tolerance_m IS '3-D error that was accepted.';
COMMENT ON COLUMN plans.marks IS 'The arrangement: names, centres in the site frame [m] and heights of poles [m].';
COMMENT ON COLUMN plans.n_marks IS 'How many marks it has.';
COMMENT ON COLUMN plans.model_version IS 'Digest of the model of centres behind the prediction.';
COMMENT ON COLUMN plans.model_source IS 'sensor, or fitted (from the marker_fits of own surveys).';
COMMENT ON COLUMN plans.request IS 'All that was asked, so that it can be asked again.';
COMMENT ON COLUMN plans.created_at IS 'When it was kept (UTC).';

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
COMMENT ON TABLE planned_stops IS 'What a kept plan promises at each of its stops.';
COMMENT ON COLUMN planned_stops.place IS 'Its place in the plan, from 0.';
COMMENT ON COLUMN planned_stops.x_m IS 'Planned place of the LiDAR in the site frame.';
COMMENT ON COLUMN planned_stops.y_m IS 'Planned place of the LiDAR in the site frame.';
COMMENT ON COLUMN planned_stops.z_m IS 'Planned place of the LiDAR in the site frame, up.';
COMMENT ON COLUMN planned_stops.n_seen IS 'Marks that will be found from there.';
COMMENT ON COLUMN planned_stops.n_used IS 'Marks that carry the position.';
COMMENT ON COLUMN planned_stops.sigma_3d_m IS 'Predicted: square root of the trace of the covariance of the position; NULL where there is none.';
COMMENT ON COLUMN planned_stops.probability_within_tolerance IS 'Predicted probability that the 3-D error is within the tolerance, 0 to 1.';
COMMENT ON COLUMN planned_stops.included_angle_min_deg IS 'Least angle between two used marks.';
COMMENT ON COLUMN planned_stops.included_angle_max_deg IS 'Greatest angle between two used marks.';
COMMENT ON COLUMN planned_stops.dop IS 'Dilution of precision; NULL where there is no position.';
COMMENT ON COLUMN planned_stops.reason IS 'Why there is no position, or a weak one; empty when all is well.';

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
COMMENT ON VIEW placements IS 'Per stop what a kept plan promised and, once a stop of that name is surveyed, what came of it.';
COMMENT ON COLUMN placements.run_id IS 'Run that surveyed the stop; NULL until then.';
COMMENT ON COLUMN placements.n_markers IS 'Markers that carried the position once surveyed.';
COMMENT ON COLUMN placements.achieved_sigma_3d_m IS 'Sigma of the position once surveyed.';
COMMENT ON COLUMN placements.error_3d_m IS 'Error of the position once surveyed; NULL without truth.';
COMMENT ON COLUMN placements.is_within_tolerance IS 'Whether that error keeps the tolerance.';
