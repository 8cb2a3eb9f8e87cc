"""The `wearline` command: its own subcommands and those that installed services offer.

A service offers a subcommand by an entry point ``wearline.commands`` that names a `Command`.
Exit 0: done; 2: cannot be done, with one line on stderr that names what, where and the cure;
130: interrupted.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
from argparse import REMAINDER, ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn, TypeVar

from wearline import __version__
from wearline.errors import UsageError, WearlineError

GROUP = "wearline.commands"
T = TypeVar("T")


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    name: str
    help: str
    configure: Callable[[ArgumentParser], None]
    """Adds the options."""
    run: Callable[[Namespace], int]
    """Does it and returns the exit code; a `WearlineError` becomes one line and exit 2."""


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, self.prog.removeprefix("wearline").strip(), f"see '{self.prog} --help'")


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Pass ``items`` on and draw a bar on stderr, where that is a terminal; else draw nothing."""
    stream = sys.stderr
    if not stream.isatty():
        yield from items
        return
    if total is None and isinstance(items, Sized):
        total = len(items)
    done = 0
    try:
        for done, item in enumerate(items):
            _draw(label, done, total)
            yield item
            done += 1
        _draw(label, done, total)
    finally:
        stream.write("\n")
        stream.flush()


def _draw(label: str, done: int, total: int | None) -> None:
    if total:
        filled = 30 * done // total
        sys.stderr.write(f"\r{label} [{'#' * filled}{'.' * (30 - filled)}] {done}/{total}")
    else:
        sys.stderr.write(f"\r{label} {done}")
    sys.stderr.flush()


def _configure_run(parser: ArgumentParser) -> None:
    parser.add_argument("service", help="capture, reconstruct, judge, fieldbus or hmi")
    parser.add_argument("rest", nargs=REMAINDER, metavar="...", help="--config CELL.yaml, --check-config or --schema")


def _run_service(arguments: Namespace) -> int:
    from wearline.topics import SERVICES

    name = arguments.service
    if name not in SERVICES:
        raise UsageError(f"there is no service '{name}'", "wearline run", f"one of {', '.join(SERVICES)}")
    module = f"wearline_{name}"
    if find_spec(module) is None or find_spec(f"{module}.__main__") is None:
        raise UsageError("is not installed here", f"service {name}", f"pip install wearline-{name}")
    sys.argv = [f"wearline run {name}", *arguments.rest]
    runpy.run_module(module, run_name="__main__", alter_sys=False)
    return 0


def _configure_router(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--zenohd", action="store_true", help="only print the same router's configuration for zenohd")


def _run_router(arguments: Namespace) -> int:
    from wearline.bus import router, router_settings
    from wearline.config import load_cell
    from wearline.log import start_log

    cell = load_cell(arguments.config)
    if arguments.zenohd:
        sys.stdout.write(json.dumps(router_settings(cell), indent=2) + "\n")
        return 0
    start_log(cell.cell, "router")
    return router(cell)


def _configure_up(parser: ArgumentParser) -> None:
    parser.add_argument("cell", type=Path, metavar="CELL.yaml")
    parser.add_argument("--with-plc-sim", action="store_true", help="a simulated PLC beside the cell")


def _run_up(arguments: Namespace) -> int:
    from wearline.supervisor import up

    return up(arguments.cell, arguments.with_plc_sim)


def _demo() -> Command:
    try:
        from wearline.demo import DEMO
    except ImportError as error:
        raise UsageError(f"needs {error.name}", "command demo", "pip install 'wearline[demo]'") from error
    return DEMO


_BUILT_IN: dict[str, Callable[[], Command]] = {
    "demo": _demo,
    "up": lambda: Command("up", "router and services of a cell on this machine, supervised", _configure_up, _run_up),
    "run": lambda: Command("run", "one service of a cell (what a container runs)", _configure_run, _run_service),
    "router": lambda: Command("router", "the router of a cell", _configure_router, _run_router),
}


def _load(point: EntryPoint) -> Command:
    try:
        command = point.load()
    except Exception as error:
        raise UsageError(
            f"cannot be loaded ({type(error).__name__}: {error})", f"command {point.name}", "mend its installation"
        ) from error
    if not isinstance(command, Command):
        raise UsageError(f"{point.value} is no Command", f"command {point.name}", "mend its installation")
    return command


def _commands(wanted: str | None) -> list[Command]:
    """The wanted command alone (others may take a second to import), or all of them."""
    offered = {point.name: point for point in entry_points(group=GROUP)}
    if wanted in _BUILT_IN:
        return [_BUILT_IN[wanted]()]
    if wanted in offered:
        return [_load(offered[wanted])]
    makers: dict[str, Callable[[], Command]] = {
        **_BUILT_IN,
        **{name: partial(_load, point) for name, point in offered.items()},
    }
    return [_offered(name, make) for name, make in makers.items()]


def _offered(name: str, make: Callable[[], Command]) -> Command:
    """For the list of commands: one that cannot be loaded says so in its place."""
    try:
        return make()
    except (UsageError, ImportError) as error:
        return Command(name, f"not available here ({' '.join(str(error).split())})", lambda _: None, lambda _: 2)


def _parser(wanted: str | None) -> ArgumentParser:
    parser = _Parser(prog="wearline", description="Measures stamped parts by laser light, next to the press.")
    parser.add_argument("--version", action="version", version=f"wearline {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in _commands(wanted):
        subparser = subparsers.add_parser(command.name, help=command.help.replace("%", "%%"), description=command.help)
        command.configure(subparser)
        subparser.set_defaults(run_command=command.run)
    return parser


def _joined(given: Sequence[str]) -> list[str]:
    """``--option -2=X`` as ``--option=-2=X``: argparse takes a value that starts with a minus for an option."""
    joined: list[str] = []
    for word in given:
        is_negative = word[:1] == "-" and word[1:2].isdigit()
        if is_negative and joined and joined[-1].startswith("--") and len(joined[-1]) > 2 and "=" not in joined[-1]:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    given = _joined(sys.argv[1:] if argv is None else argv)
    try:
        wanted = given[0] if given and not given[0].startswith("-") else None
        arguments = _parser(wanted).parse_args(given)
        code: int = arguments.run_command(arguments)
        sys.stdout.flush()
    except WearlineError as error:
        sys.stderr.write(f"wearline: {error}\n")
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of our output has gone (`| head`); Python must not complain again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        place = error.filename or "wearline"
        sys.stderr.write(f"wearline: {place}: {error.strerror or error}; check the path, its rights and free space\n")
        return 2
    return code
