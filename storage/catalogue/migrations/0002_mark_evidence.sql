-- Evidence that adds up over the stops of a survey. Likelihoods are natural logarithms.

-- Likelihood of each compared group of returns of a stop under each hypothesis; what fit_method gives its centre is in marker_fits or possible_fits.
CREATE TABLE group_likelihoods (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    marker VARCHAR,  -- Name of the marker, M01, M02 ..., or of the possible one, P01, P02 ...; NULL of a refused group.
    x_m DOUBLE NOT NULL,  -- Position in the station frame.
    y_m DOUBLE NOT NULL,  -- Position in the station frame.
    z_m DOUBLE NOT NULL,  -- Position in the station frame, up.
    n_points INTEGER NOT NULL,  -- Number of its returns.
    reason VARCHAR NOT NULL,  -- The most likely other hypothesis, with its odds.
    log_likelihoods DOUBLE[] NOT NULL  -- Of the hypotheses marker, sphere of another radius, boulder on the ground, head on shoulders, short cylinder, post, box, panel or edge or leaf, and foliage or other clutter.
);

-- Centres of possible markers in the station frame, one row per stop, possible marker and fitting method; a network uses those that other stations or control confirm.
CREATE TABLE possible_fits (
    run_id VARCHAR NOT NULL,
    stop VARCHAR NOT NULL,
    fit_method VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,  -- P01, P02 ... within one stop.
    status VARCHAR NOT NULL,  -- ok or weak: how well it is placed.
    reason VARCHAR NOT NULL,  -- Why it is weak; empty when it is not.
    x_m DOUBLE NOT NULL,  -- Centre in the station frame.
    y_m DOUBLE NOT NULL,  -- Centre in the station frame.
    z_m DOUBLE NOT NULL,  -- Centre in the station frame, up.
    cov_xx_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_xy_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_xz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_yy_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_yz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    cov_zz_m2 DOUBLE,  -- Covariance of the centre in the station frame, without levelling.
    sigma_3d_m DOUBLE,  -- Square root of the trace of the covariance, heading included.
    range_m DOUBLE NOT NULL,  -- From the mean beam origin to the centre.
    n_points INTEGER NOT NULL,  -- Returns that the fit used.
    n_rings INTEGER NOT NULL,  -- Different lasers among the used returns; 0 when the log has no lasers.
    sigma0 DOUBLE,  -- Square root of the variance factor; 1 means noise as assumed.
    radius_m DOUBLE NOT NULL,  -- Assumed radius.
    radius_free_m DOUBLE,  -- Radius when estimated together with the centre; NULL when the returns do not determine it.
    sigma_radius_free_m DOUBLE,  -- Standard deviation of radius_free_m.
    sigma_range_shared_m DOUBLE,  -- Standard deviation of the range error that all centres of the stop share.
    range_by_optics_m DOUBLE[],  -- Change of the range to the centre with each unknown of the optics.
    optics DOUBLE[],  -- What the scan shows of the optics, as in marker_fits.
    probability DOUBLE,  -- Posterior probability that it is a marker.
    hypothesis VARCHAR NOT NULL,  -- The most likely other hypothesis, with its odds.
    PRIMARY KEY (run_id, stop, fit_method, marker)
);

-- What all stations of a network together make of each mark, and of what may be one.
CREATE TABLE mark_decisions (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,  -- Name of the mark; in adjusted_marks where the network uses it.
    is_used BOOLEAN NOT NULL,  -- Whether it is a mark of the network.
    decision VARCHAR NOT NULL,  -- confirmed, doubtful or refused.
    probability DOUBLE NOT NULL,  -- Posterior probability that a marker stands there, by all stations.
    decoy VARCHAR NOT NULL,  -- The most likely other hypothesis.
    hypothesis VARCHAR NOT NULL,  -- The same with its odds.
    log_odds_prior DOUBLE NOT NULL,  -- Logarithm of the odds of a marker against the decoy before any scan.
    log_odds_radius DOUBLE NOT NULL,  -- What the own radius of all its fits adds, where the decoy is a sphere of nearly that radius; else 0.
    log_odds DOUBLE NOT NULL,  -- Of a marker against the decoy after all scans: the prior, the radius, and the sum over the stations.
    n_marker INTEGER NOT NULL,  -- Stations that show a marker there.
    n_possible INTEGER NOT NULL,  -- Stations that show a possible one.
    n_refused INTEGER NOT NULL,  -- Stations that show another object.
    n_nothing INTEGER NOT NULL,  -- Stations near enough that show nothing.
    n_hidden INTEGER NOT NULL,  -- Stations near enough from which it is hidden.
    x_m DOUBLE NOT NULL,  -- Approximate place in the frame of the network.
    y_m DOUBLE NOT NULL,  -- Approximate place in the frame of the network.
    z_m DOUBLE NOT NULL,  -- Approximate place in the frame of the network, up.
    PRIMARY KEY (adjustment_id, mark)
);

-- The evidence of each station that is near enough to a mark to see it.
CREATE TABLE mark_evidence (
    adjustment_id VARCHAR NOT NULL,
    mark VARCHAR NOT NULL,
    station VARCHAR NOT NULL,
    marker VARCHAR NOT NULL,  -- What it is called at the station; empty where there is none.
    finding VARCHAR NOT NULL,  -- marker, possible, refused (another object), nothing, or hidden.
    range_m DOUBLE NOT NULL,  -- Distance from the station to the mark.
    log_odds DOUBLE NOT NULL,  -- Logarithm of how much likelier a marker makes it than the decoy of the mark.
    reason VARCHAR NOT NULL,  -- What it is there; empty where nothing is known.
    PRIMARY KEY (adjustment_id, mark, station)
);
