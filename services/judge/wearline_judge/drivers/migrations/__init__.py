"""Schema of the records by version, for Alembic."""
