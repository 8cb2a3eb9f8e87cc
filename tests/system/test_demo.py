"""`wearline demo`, as a newcomer runs it: the whole cell in processes of its own, over the real S7 protocol."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

STROKES = 12
PERIOD_S = "0.5"


def free_base_port() -> int:
    """A port with eight free ones behind it."""
    for base in range(20_000 + os.getpid() % 9000, 60_000, 16):
        try:
            for port in range(base, base + 9):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return base
    raise RuntimeError("no free ports")


def demo(folder: Path, base_port: int, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            sys.executable, "-m", "wearline", "demo", "--headless", "--data", str(folder),
            "--base-port", str(base_port),
            "--stroke-period", PERIOD_S, *options,
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def of_folder(folder: Path) -> list[psutil.Process]:
    """Every process that names the folder on its command line."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        if any(str(folder) in word for word in process.info["cmdline"] or []):
            found.append(process)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def base_port() -> int:
    return free_base_port()


@pytest.fixture(scope="module")
def first_run(folder: Path, base_port: int) -> Iterator[tuple[int, str]]:
    process = demo(folder, base_port, "--strokes", str(STROKES))
    try:
        said, _ = process.communicate(timeout=100)
    finally:
        process.kill()
    yield process.returncode, said


def test_a_counted_run_keeps_every_promise_and_exits_0(first_run: tuple[int, str]) -> None:
    code, said = first_run
    assert code == 0, said
    assert f"{STROKES} strokes in" in said
    assert f"records: {STROKES} of {STROKES}; PLC log agrees on {STROKES} of {STROKES}" in said
    assert said.rstrip().endswith("as promised")
    assert re.search(r"HMI: http://127\.0\.0\.1:\d+/", said)


def test_every_stroke_is_shown_with_its_figures(first_run: tuple[int, str]) -> None:
    rows = re.findall(
        r"^stroke +(\d+) +(\w+) +mean (\S+) mm +max (\S+) mm +wear (\S+) mm +(\d+) ms", first_run[1], re.M
    )
    assert [int(row[0]) for row in rows] == list(range(1, STROKES + 1))
    assert all(row[1] == "PASSED" for row in rows), "a fresh die makes good parts"
    assert all(float(row[2]) < 0.1 for row in rows)


def test_nothing_is_left_behind(first_run: tuple[int, str], folder: Path) -> None:
    assert of_folder(folder) == []


def test_a_second_run_regrinds_the_die_goes_on_and_ends_with_ctrl_c(
    first_run: tuple[int, str], folder: Path, base_port: int
) -> None:
    process = demo(folder, base_port)
    assert process.stdout is not None
    seen: list[str] = []
    try:
        deadline_s = time.monotonic() + 60.0
        for text in process.stdout:
            seen.append(text)
            if re.match(rf"stroke +{STROKES + 2} ", text):
                break
            assert time.monotonic() < deadline_s, "".join(seen)
        stopped_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)
        seconds = time.monotonic() - stopped_s
    finally:
        process.kill()
    said = "".join(seen)
    assert process.returncode == 0, said
    assert seconds <= 3.0
    assert f"die reground after stroke {STROKES}" in said
    assert "prepared in" not in said, "the second start finds its data"
    assert of_folder(folder) == []


def test_a_second_demo_in_the_same_folder_is_refused_in_one_sentence(
    first_run: tuple[int, str], folder: Path, base_port: int
) -> None:
    import fcntl

    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = demo(folder, base_port, "--strokes", "1")
        said, _ = process.communicate(timeout=30)
    assert process.returncode == 2
    assert said.count("\n") == 1
    assert "another demo runs there" in said


def test_a_taken_port_is_named_with_its_cure(first_run: tuple[int, str], folder: Path, base_port: int) -> None:
    with socket.socket() as taken:
        # Connections of the runs before may linger there.
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", base_port))
        taken.listen()
        process = demo(folder, base_port, "--strokes", "1")
        said, _ = process.communicate(timeout=30)
    assert process.returncode == 2
    assert f"port {base_port} is taken" in said
    assert "cell.yaml" in said
    assert of_folder(folder) == []
