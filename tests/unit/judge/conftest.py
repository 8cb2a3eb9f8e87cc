"""A PostgreSQL server for the tests: its own folder, a Unix socket, no network."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text


def _tools() -> Path | None:
    """Folder of initdb and pg_ctl (Debian keeps them off the path)."""
    found = shutil.which("initdb")
    if found:
        return Path(found).parent
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return folders[-1].parent if folders else None


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """URL of a fresh server's maintenance database."""
    tools = _tools()
    if tools is None:
        pytest.skip("PostgreSQL is not installed (Debian package postgresql)")
    as_user: list[str] = []
    folder = Path(tempfile.mkdtemp(prefix="wearline-pg-"))
    if os.geteuid() == 0:
        # PostgreSQL refuses to run as root.
        try:
            owner = pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("there is no user postgres to run PostgreSQL as")
        os.chown(folder, owner.pw_uid, owner.pw_gid)
        as_user = ["runuser", "-u", "postgres", "--"]

    def run(*command: str) -> None:
        subprocess.run([*as_user, *command], check=True, capture_output=True, cwd="/", timeout=60)

    cluster = str(folder / "cluster")
    run(str(tools / "initdb"), "-D", cluster, "-A", "trust", "-U", "postgres", "--data-checksums", "-E", "UTF8")
    options = f"-k {folder} -c listen_addresses='' -c unix_socket_permissions=0777"
    folder.chmod(0o755)
    run(str(tools / "pg_ctl"), "-D", cluster, "-o", options, "-l", str(folder / "log"), "-w", "start")
    try:
        yield f"postgresql+psycopg://postgres@/postgres?host={folder}"
    finally:
        run(str(tools / "pg_ctl"), "-D", cluster, "-m", "immediate", "-w", "stop")
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[str], str]:
    """Makes an empty database of either kind and returns its URL."""
    if request.param == "sqlite":
        return lambda name: f"sqlite:///{tmp_path}/{name}.db"
    server: str = request.getfixturevalue("postgres")

    def made(name: str) -> str:
        own = f"{name}_{abs(hash(str(tmp_path))):x}"
        engine = create_engine(server, isolation_level="AUTOCOMMIT")
        with engine.connect() as db:
            db.execute(text(f'CREATE DATABASE "{own}"'))
        engine.dispose()
        return server.replace("/postgres?", f"/{own}?")

    return made
