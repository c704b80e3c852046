-- How much of each centre's error of range all centres of its stop have in common.

ALTER TABLE marker_fits ADD COLUMN sigma_range_shared_m DOUBLE;
COMMENT ON COLUMN marker_fits.sigma_range_shared_m IS 'Standard deviation of what all centres of the stop are too far together, as their covariances have it; NULL where the method does not tell.';

CREATE OR REPLACE VIEW latest_marker_fits AS
SELECT r.survey_id, s.name AS survey, r.recording_id, m.*
FROM marker_fits AS m JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);
COMMENT ON VIEW latest_marker_fits IS 'marker_fits of the newest run of each recording, with the survey.';
