"""Brings the tables of a database to the version that this code knows."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection, inspect, text

HEAD = "0002"


def version_of(connection: Connection) -> str:
    """The version of the tables that are there; empty = none."""
    if not inspect(connection).has_table("alembic_version"):
        return ""
    return str(connection.execute(text("SELECT version_num FROM alembic_version")).scalar() or "")


def migrate(connection: Connection, target: str = HEAD) -> None:
    """Upgrade or downgrade to a version ("base" = no tables), within the caller's transaction.

    Raises:
        ValueError: the tables are of a version that this code does not know.
    """
    found = version_of(connection)
    if found == target:
        return
    # Alembic is needed once in the life of a database; its import takes a third of a second.
    from alembic import command
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    try:
        if target == "base" or (found and found > target):
            command.downgrade(config, target)
        else:
            command.upgrade(config, target)
    except CommandError as error:
        raise ValueError(f"its tables are of version {found}, this code knows {HEAD}: {error}") from error
