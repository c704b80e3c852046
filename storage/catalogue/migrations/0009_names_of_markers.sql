-- A marker has the name of the group of returns that it was found in: one sphere, one name, by
-- whatever method its centre was fitted.

COMMENT ON COLUMN marker_fits.marker IS 'M01, M02 ... by azimuth, within one stop: the same sphere by every method; a method that refused it has no row.';
