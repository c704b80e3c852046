-- Logs that were uploaded for a survey, whether a job has read them or not.

CREATE TABLE survey_recordings (
    survey_id VARCHAR NOT NULL,
    recording_id VARCHAR NOT NULL,
    PRIMARY KEY (survey_id, recording_id)
);
COMMENT ON TABLE survey_recordings IS 'Logs that were uploaded for a survey; those that its jobs read belong to it too.';

