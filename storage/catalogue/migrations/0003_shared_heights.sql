-- Errors of height that all centres of a stop share, by the difference between their limbs above and below.
ALTER TABLE marker_fits ADD COLUMN sigma_height_shared_m DOUBLE;  -- Standard deviation of the error of height that all centres of the stop share, part of their covariances; NULL in runs of earlier versions.
ALTER TABLE possible_fits ADD COLUMN sigma_height_shared_m DOUBLE;  -- Standard deviation of the error of height that all centres of the stop share.
