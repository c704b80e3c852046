-- Where boxes were compared, solids of any other shape are.
COMMENT ON COLUMN group_likelihoods.log_likelihoods IS 'Of the hypotheses marker, sphere of another radius, boulder on the ground, head on shoulders, short cylinder, post, solid of another shape (earlier versions: box), panel or edge or leaf, and foliage or other clutter.';
