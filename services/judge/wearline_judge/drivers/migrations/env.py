"""Run by Alembic: migrate the connection that `wearline_judge.drivers.schema` hands over."""

from alembic import context

from wearline_judge.drivers.tables import METADATA

context.configure(connection=context.config.attributes["connection"], target_metadata=METADATA, render_as_batch=True)
with context.begin_transaction():
    context.run_migrations()
