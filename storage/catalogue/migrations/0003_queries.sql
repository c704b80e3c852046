-- Queries that were kept under a name, to be shared by their address.
CREATE TABLE saved_queries (
    name VARCHAR PRIMARY KEY,  -- Name in the address.
    sql VARCHAR NOT NULL,  -- One SELECT; $name stands for a parameter.
    parameters JSON NOT NULL,  -- Values of its parameters where an address gives none.
    changed_at TIMESTAMPTZ NOT NULL  -- Instant of the last change (UTC).
);
