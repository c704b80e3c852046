"""The one owner of DuckDB: schema, surveys, jobs, results, snapshots, SQL of users."""
