"""The command line: what it prints where, and what it exits with."""

from __future__ import annotations

import io
import subprocess
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

import pytest

from wearline import cli
from wearline.cli import Command, main, progress
from wearline.errors import RecipeError


def offer(monkeypatch: pytest.MonkeyPatch, run: object, name: str = "probe") -> None:
    def configure(parser: ArgumentParser) -> None:
        parser.add_argument("--times", type=int, default=1)

    command = Command(name, "100 % a probe", configure, run)  # type: ignore[arg-type]
    monkeypatch.setitem(cli._BUILT_IN, name, lambda: command)


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("wearline: ")
    return shown.err


@pytest.mark.parametrize("code", [0, 1, 3])
def test_the_exit_code_is_the_commands(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    offer(monkeypatch, lambda arguments: code)
    assert main(["probe"]) == code


def test_a_wearline_error_is_one_line_and_exit_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(arguments: Namespace) -> int:
        raise RecipeError("what\nof two lines", "where.yaml", "the cure")

    offer(monkeypatch, run)
    assert main(["probe"]) == 2
    assert one_line(capsys) == "wearline: where.yaml: what of two lines; the cure\n"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["no-such-command"],
        ["--no-such-option"],
        ["probe", "--times", "many"],
        ["probe", "--no-such-option"],
        ["run"],
        ["run", "no-such-service"],
        ["router"],
        ["router", "--config", "/no/such/cell.yaml"],
        ["up", "/no/such/cell.yaml"],
    ],
    ids=" ".join,
)
def test_a_wrong_call_is_one_line_and_exit_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    offer(monkeypatch, lambda arguments: 0)
    assert main(arguments) == 2
    one_line(capsys)


def test_a_file_that_cannot_be_written_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    offer(monkeypatch, lambda arguments: len(Path("/no/such/folder/file").read_bytes()))
    assert main(["probe"]) == 2
    assert "/no/such/folder/file: No such file or directory" in one_line(capsys)


def test_an_interrupt_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(arguments: Namespace) -> int:
        raise KeyboardInterrupt

    offer(monkeypatch, run)
    assert main(["probe"]) == 130
    assert capsys.readouterr().err == ""


def test_help_lists_every_command_and_survives_a_broken_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> Command:
        raise ImportError("No module named 'nothing'")

    offer(monkeypatch, lambda arguments: 0)
    monkeypatch.setitem(cli._BUILT_IN, "broken", broken)
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for name in ("run", "router", "up", "demo", "probe"):
        assert f"\n    {name}" in shown
    assert "100 % a probe" in shown
    assert "not available here" in shown


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_draws_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress([1, 2], "frames")) == [1, 2]
    assert capsys.readouterr() == ("", "")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    assert list(progress([1, 2], "frames")) == [1, 2]
    assert terminal.getvalue().endswith("frames [##############################] 2/2\n")
    assert list(progress(iter("ab"), "frames")) == ["a", "b"]
    assert terminal.getvalue().endswith("frames 2\n")


def test_the_command_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "wearline", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("wearline ")
