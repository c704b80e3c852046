-- What is made of all stops of a survey together: clouds in one frame, elevation models.

CREATE TABLE site_products (
    product_id VARCHAR NOT NULL,
    job_id VARCHAR NOT NULL,
    survey_id VARCHAR NOT NULL,
    kind VARCHAR NOT NULL,
    url VARCHAR NOT NULL,
    sha256 VARCHAR NOT NULL,
    size_bytes BIGINT NOT NULL,
    n_points BIGINT NOT NULL,
    n_stations INTEGER NOT NULL,
    poses VARCHAR NOT NULL,
    adjustment_id VARCHAR,
    min_x_m DOUBLE NOT NULL,
    min_y_m DOUBLE NOT NULL,
    min_z_m DOUBLE NOT NULL,
    max_x_m DOUBLE NOT NULL,
    max_y_m DOUBLE NOT NULL,
    max_z_m DOUBLE NOT NULL,
    cell_m DOUBLE,
    share_known DOUBLE,
    sigma_median_m DOUBLE,
    config_digest VARCHAR NOT NULL,
    code_version VARCHAR NOT NULL,
    finished_at TIMESTAMPTZ NOT NULL,
    PRIMARY KEY (product_id, kind)
);
COMMENT ON TABLE site_products IS 'Files made of all stops of a survey: clouds in the site frame and elevation models.';
COMMENT ON COLUMN site_products.product_id IS 'The same for all files of one job.';
COMMENT ON COLUMN site_products.kind IS 'laz, e57 or geotiff.';
COMMENT ON COLUMN site_products.url IS 'Where the file is kept.';
COMMENT ON COLUMN site_products.sha256 IS 'Digest of its bytes.';
COMMENT ON COLUMN site_products.size_bytes IS 'Length of the file.';
COMMENT ON COLUMN site_products.n_points IS 'Returns in the cloud, or returns that carry the heights.';
COMMENT ON COLUMN site_products.n_stations IS 'Stations whose returns are in it.';
COMMENT ON COLUMN site_products.poses IS 'Where the poses are from: control or free (an adjustment), or fixes (each station alone).';
COMMENT ON COLUMN site_products.adjustment_id IS 'The adjustment that the poses are from; NULL where each station was positioned alone.';
COMMENT ON COLUMN site_products.min_x_m IS 'Least coordinate in the site frame.';
COMMENT ON COLUMN site_products.min_y_m IS 'Least coordinate in the site frame.';
COMMENT ON COLUMN site_products.min_z_m IS 'Least coordinate in the site frame, up.';
COMMENT ON COLUMN site_products.max_x_m IS 'Greatest coordinate in the site frame.';
COMMENT ON COLUMN site_products.max_y_m IS 'Greatest coordinate in the site frame.';
COMMENT ON COLUMN site_products.max_z_m IS 'Greatest coordinate in the site frame, up.';
COMMENT ON COLUMN site_products.cell_m IS 'Edge of a cell of an elevation model.';
COMMENT ON COLUMN site_products.share_known IS 'Share of its cells in which ground was seen.';
COMMENT ON COLUMN site_products.sigma_median_m IS 'Median of the standard deviations of its heights.';
