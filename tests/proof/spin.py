"""Exhaustive search of a Promela model with Spin (Debian: spin, gcc): spin -a, gcc, pan, and what pan said."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

NEEDED = ("spin", "gcc")
DEPTH = 1_000_000
"""Longest path that is followed; a longer one makes the search incomplete, and that counts as an error."""
MEMORY_MB = 3000


def missing() -> str:
    """What is not installed here, as a reason to skip; empty when all is there."""
    absent = [name for name in NEEDED if shutil.which(name) is None]
    return f"{' and '.join(absent)} not installed (Debian: apt-get install spin gcc libc6-dev)" if absent else ""


@dataclass(frozen=True)
class Search:
    """What one search found."""

    name: str
    states: int
    transitions: int
    depth: int
    seconds: float
    error: str
    """Empty, or what pan reported: a violated assertion, an invalid end state, a non-progress cycle."""
    is_exhaustive: bool
    """Every reachable state was expanded: nothing was cut off, hashed away or left in a queue."""
    unreached: frozenset[int]
    """Lines of the model that no path reaches."""
    story: str = ""
    """The counterexample as the model tells it."""

    @property
    def holds(self) -> bool:
        """All states were searched and none is wrong."""
        return self.is_exhaustive and not self.error

    def row(self) -> str:
        """One line of a printed table."""
        found = self.error or ("no error, exhaustive" if self.is_exhaustive else "TRUNCATED")
        size = f"{self.states:>10,} {self.transitions:>11,} {self.depth:>7,}"
        return f"{self.name:<58} {size} {self.seconds:>7.1f} s  {found}"


HEADER = f"{'search':<58} {'states':>10} {'transitions':>11} {'depth':>7} {'time':>9}"


@dataclass(frozen=True)
class Pan:
    """One compiled model."""

    folder: Path
    is_liveness: bool = False

    def search(
        self,
        name: str,
        parameters: Mapping[str, int] | None = None,
        without: Sequence[int] = (),
        timeout_s: float = 900.0,
    ) -> Search:
        """Search all states with these parameters and without these guards; stops at the first error.

        Raises:
            RuntimeError: pan ends without its report.
        """
        environment = {**os.environ, "WITHOUT": ",".join(map(str, without))}
        environment |= {key: str(value) for key, value in (parameters or {}).items()}
        options = ["-l", "-f"] if self.is_liveness else []
        (self.folder / "model.pml.trail").unlink(missing_ok=True)
        said = _run(["./pan", f"-m{DEPTH}", "-w22", *options], self.folder, timeout_s, environment)
        story = ""
        if (self.folder / "model.pml.trail").is_file():
            replayed = _run(["./pan", "-r"], self.folder, timeout_s, environment)
            story = "\n".join(line.strip()[2:] for line in replayed.splitlines() if line.lstrip().startswith("| "))
        return _read(name, said, story)


def compile_model(text: str, folder: Path, is_liveness: bool = False) -> Pan:
    """Make the verifier of one model text; its parameters are read when it runs.

    ``is_liveness``: it looks for cycles without progress under weak fairness, instead of assertions and end states.

    Raises:
        RuntimeError: spin or gcc refuse it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.pml").write_text(text, encoding="utf-8")
    _run(["spin", "-a", "model.pml"], folder, 120.0)
    kind = ["-DNP", "-DNFAIR=3"] if is_liveness else ["-DSAFETY"]
    _run(["gcc", "-O1", "-w", f"-DMEMLIM={MEMORY_MB}", "-DCOLLAPSE", *kind, "-o", "pan", "pan.c"], folder, 300.0)
    return Pan(folder, is_liveness)


def _run(command: Sequence[str], folder: Path, timeout_s: float, environment: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, timeout=timeout_s, env=environment, check=False
    )  # fmt: skip
    said = (done.stdout + done.stderr).decode("utf-8", errors="replace")
    if "rror: syntax" in said or (done.returncode != 0 and command[0] != "./pan"):
        raise RuntimeError(f"{' '.join(command)}: {said.strip()[-2000:]}")
    return said


def _number(pattern: str, said: str) -> float:
    found = re.search(pattern, said)
    return float(found.group(1)) if found else 0.0


def _read(name: str, said: str, story: str) -> Search:
    if "State-vector" not in said:
        raise RuntimeError(f"{name}: pan made no report: {said.strip()[-2000:]}")
    error = re.search(r"^pan:\d+: (.*?)(?: \(at depth \d+\))?$", said, re.MULTILINE)
    cut = any(text in said for text in ("max search depth too small", "out of memory", "MEMLIM bound", "not completed"))
    whole = "Full statespace search" in said and "errors: 0" in said and not cut
    return Search(
        name=name,
        states=int(_number(r"([\d.e+]+) states, stored", said)),
        transitions=int(_number(r"([\d.e+]+) transitions", said)),
        depth=int(_number(r"depth reached (\d+)", said)),
        seconds=_number(r"elapsed time ([\d.]+) seconds", said),
        error=error.group(1).strip() if error else ("" if "errors: 0" in said else "pan reports an error"),
        is_exhaustive=whole,
        unreached=frozenset(int(line) for line in re.findall(r"model\.pml:(\d+), state", said)),
        story=story,
    )
