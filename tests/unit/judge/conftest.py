"""A PostgreSQL server for the tests: its own folder, a Unix socket, no network."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from sqlalchemy import create_engine, text

from tests.metrology.chains import comb_calibration
from tests.unit.judge.rendered import COMB, image, options, recorded_cell
from wearline.artifact import Calibration
from wearline.cli import main
from wearline.messages import Verdict


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


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames good, bad and hopeless, with calibration, recipe and template."""
    folder = tmp_path_factory.mktemp("frames")
    found = comb_calibration(COMB, (0.0, 0.0, 3.0, 3.0, 6.0, 6.0))
    Calibration.from_bytes(found.to_bytes(), "c").save(folder / "C.npz")
    (folder / "R.yaml").write_text("mm_per_pixel: 0.1\n")
    for n in range(4):
        cv2.imwrite(str(folder / f"g{n}.png"), image(0.0, 20 + n))
    cv2.imwrite(str(folder / "good.png"), image(0.0, 40))
    cv2.imwrite(str(folder / "bad.png"), image(0.25, 41))
    cv2.imwrite(str(folder / "black.png"), np.zeros((480, 640), np.uint8))
    cv2.imwrite(str(folder / "white.png"), np.full((480, 640), 255, np.uint8))
    cv2.imwrite(str(folder / "small.png"), image(0.0, 42)[:240, :320])
    cv2.imwrite(str(folder / "deep.png"), np.zeros((480, 640), np.uint16))
    cv2.imwrite(str(folder / "colour.png"), np.zeros((480, 640, 3), np.uint8))
    whole = (folder / "good.png").read_bytes()
    (folder / "cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "text.png").write_text("not an image\n")
    assert main(["template", *(str(folder / f"g{n}.png") for n in range(4)), *options(folder, template=False),
                 "--out", str(folder / "T.npz")]) == 0  # fmt: skip
    return folder


@pytest.fixture
def recorded(files: Path, tmp_path: Path) -> tuple[Path, Verdict]:
    """A cell with two recorded parts and their frames; the verdict is that of the failed one."""
    return recorded_cell(files, tmp_path)


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
