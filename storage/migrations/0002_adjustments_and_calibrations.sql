-- Jobs of several kinds: over several logs, with a rig of their own, with options of the kind.

ALTER TABLE jobs ADD COLUMN options JSON DEFAULT '{}';
COMMENT ON COLUMN jobs.options IS 'What was chosen beside the configuration: rig (a digest), recordings (where the job reads several), and what its kind lets one choose.';

ALTER TABLE surveys ADD COLUMN rig_digest VARCHAR;
COMMENT ON COLUMN surveys.rig_digest IS 'Rig that its jobs use where they name none; NULL: the one that each log describes.';

COMMENT ON TABLE rigs IS 'Every rig that a run used, that a calibration gave or that somebody entered, as JSON.';
