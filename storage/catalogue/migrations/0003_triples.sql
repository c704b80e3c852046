-- Positions from triples of marks beside those from pairs, and what they are in the plane.

ALTER TABLE resections ADD COLUMN included_angle_max_deg DOUBLE;
ALTER TABLE resections ADD COLUMN sigma_horizontal_m DOUBLE;
ALTER TABLE resections ADD COLUMN error_horizontal_m DOUBLE;
UPDATE resections SET included_angle_max_deg = included_angle_deg;

COMMENT ON TABLE resections IS 'The station positioned from each pair and each triple of marks alone (with gravity), in the site frame, by each resection method.';
COMMENT ON COLUMN resections.n_marks IS 'How many; 2 for pairs, 3 for triples.';
COMMENT ON COLUMN resections.included_angle_deg IS '3-D angle at the station between the two centres; of three the smallest of the three angles.';
COMMENT ON COLUMN resections.included_angle_max_deg IS 'The same; of three the largest of the three angles.';
COMMENT ON COLUMN resections.included_angle_horizontal_deg IS 'The smallest angle in the levelled plane.';
COMMENT ON COLUMN resections.sigma_horizontal_m IS 'Square root of the trace of the covariance of x and y; NULL for rows of versions before triples.';
COMMENT ON COLUMN resections.error_horizontal_m IS 'Length of estimate minus truth in the plane; NULL without truth, and for rows of versions before triples.';

CREATE OR REPLACE VIEW accuracy_by_included_angle AS
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
