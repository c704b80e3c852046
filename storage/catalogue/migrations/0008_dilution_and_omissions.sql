-- Geometry of a station as one number, and what each marker does to its position.

ALTER TABLE station_fixes ADD COLUMN dop DOUBLE;
COMMENT ON COLUMN station_fixes.dop IS 'Dilution of precision: 3-D sigma of the position, levelled, for observations that all have a sigma of 1; NULL where there is none, and for rows of older versions.';

ALTER TABLE observations ADD COLUMN shift_without_m DOUBLE;
COMMENT ON COLUMN observations.shift_without_m IS 'How far the station moves when this marker is left out; NULL for markers that are not used, methods by ranges, and rows of older versions.';

CREATE OR REPLACE VIEW latest_station_fixes AS
SELECT r.survey_id, s.name AS survey, r.recording_id, f.*
FROM station_fixes AS f JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id);
COMMENT ON VIEW latest_station_fixes IS 'station_fixes of the newest run of each recording, with the survey.';
