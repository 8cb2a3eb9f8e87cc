"""With certificates, each participant says only what is its own: real routers, real certificates, real forgers."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.contract.conftest import DEADLINE_S, Heard, free_port, until
from tests.contract.examples import EXAMPLES, VERDICT
from wearline import messages as m
from wearline.access import ASKS, HEARS, access_control
from wearline.bus import Bus, _config, _plain_settings, _tls_settings, open_router, router_settings
from wearline.cli import main
from wearline.config import CellSettings, RouterSettings, TlsSettings, load_cell
from wearline.errors import BusError, ConfigError
from wearline.messages import encode
from wearline.topics import QUERIES, SERVICES, TOPICS, Query, Topic, alive_key
from wearline.topics import VERDICT as VERDICTS

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "deploy" / "zenoh" / "certificates.sh"
JUDGE_KEY = VERDICTS.key("c1")


def issue(folder: Path, cell: str, names: str = "") -> None:
    environment = {"PATH": "/usr/local/bin:/usr/bin:/bin", **({"NAMES": names} if names else {})}
    done = subprocess.run(
        [str(SCRIPT), cell, str(folder)], capture_output=True, text=True, env=environment, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of everybody in cell c1, one that no rule knows, another cell's judge, and one of another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (Debian: apt install openssl)")
    folder = tmp_path_factory.mktemp("certificates")
    issue(folder, "c1")
    issue(folder, "c1", "rogue")
    issue(folder / "c2", "c2", "judge")
    shutil.copytree(folder, folder / "neighbour")
    issue(folder / "neighbour", "c2", "judge")
    return folder


@pytest.fixture
def cell(tmp_path: Path, certificates: Path) -> CellSettings:
    """A cell whose bus asks for certificates."""
    tls = TlsSettings(authority=certificates / "authority.pem", folder=certificates)
    return CellSettings(
        cell="c1", data_dir=tmp_path, router=RouterSettings(endpoint=f"tls/127.0.0.1:{free_port()}", tls=tls)
    )


@pytest.fixture
def join(cell: CellSettings) -> Iterator[Callable[[str], Bus]]:
    opened: list[Bus] = []

    def open_bus(service: str) -> Bus:
        bus = Bus(cell.cell, service, cell.router.endpoint, cell.router.tls)
        opened.append(bus)
        bus.open(timeout_s=DEADLINE_S)
        return bus

    yield open_bus
    for bus in opened:
        bus.close()


@pytest.fixture
def pretend(cell: CellSettings) -> Iterator[Callable[[str, Path], zenoh.Session]]:
    """A bare session with somebody's certificate: what a program that is not ours would do."""
    opened: list[zenoh.Session] = []

    def open_session(name: str, folder: Path) -> zenoh.Session:
        tls = TlsSettings(authority=folder / "authority.pem", folder=folder)
        settings = {
            **_plain_settings("client"),
            **_tls_settings(tls, name),
            "connect/endpoints": [cell.router.endpoint],
            "connect/timeout_ms": 0,
        }
        opened.append(zenoh.open(_config(settings)))
        return opened[-1]

    yield open_session
    for session in opened:
        session.close()  # type: ignore[no-untyped-call]


Join = Callable[[str], Bus]
Pretend = Callable[[str, Path], zenoh.Session]


def example(topic: Topic) -> m.Message:
    found = next(e for e in EXAMPLES if type(e) is topic.message)
    return found.replace(service=topic.publisher) if topic.message in (m.ServiceState, m.Event) else found


def answered(query: Query) -> m.Message:
    return next(e for e in EXAMPLES if type(e) is query.answer)


# --- what is allowed works ---


def test_each_topic_reaches_those_that_may_hear_it(running_router: CellSettings, join: Join) -> None:
    buses = {service: join(service) for service in SERVICES}
    heard: dict[tuple[str, Topic], Heard] = {}
    for service, topics in HEARS.items():
        for topic in topics:
            heard[service, topic] = Heard()
            # Its own session hears a publisher in any case: what counts is what the router passes on.
            listener = join(service) if topic.publisher == service else buses[service]
            listener.subscribe(topic, heard[service, topic])
    for topic in TOPICS:
        hearers = [heard[service, topic] for service in SERVICES if topic in HEARS[service]]
        message = example(topic)
        until(lambda: buses[topic.publisher].publish(message) is topic and all(h.items for h in hearers))  # noqa: B023


def test_each_question_reaches_its_answerer_and_the_answer_comes_back(running_router: CellSettings, join: Join) -> None:
    buses = {service: join(service) for service in SERVICES}
    for query in QUERIES:
        buses[query.answerer].answer(query, lambda question, query=query: answered(query))  # type: ignore[misc]
    for service, queries in ASKS.items():
        for query in queries:
            question = next((e for e in EXAMPLES if type(e) is query.ask), None) or query.ask()
            argument = "3" if query.name.endswith("**") else ""
            answers: list[m.Message] = []

            def ask(bus: Bus = buses[service], query: Query = query, question: m.Message = question) -> bool:
                try:
                    answers.append(bus.ask(query, question, argument, timeout_s=DEADLINE_S))  # noqa: B023
                except BusError:
                    return False
                return True

            until(ask)
            assert [encode(answer) for answer in answers] == [encode(answered(query))], f"{service} asks {query.name}"


def test_what_is_kept_reaches_who_comes_late_and_who_is_alive_is_known(
    running_router: CellSettings, join: Join
) -> None:
    judge, heard, alive = join("judge"), Heard(), Heard()
    for number in range(3):
        judge.publish(VERDICT.replace(reason=str(number)))
    judge.announce()
    fieldbus = join("fieldbus")
    fieldbus.subscribe(VERDICTS, heard)
    fieldbus.watch_alive(alive)
    assert [v.reason for v in heard.wait_for(lambda items: len(items) == 3)] == ["0", "1", "2"]
    alive.wait_for(lambda items: items == [("judge", frozenset({judge.instance}))])


# --- what is not allowed reaches nobody ---

FORGERS = ["hmi", "capture", "rogue", "judge of c2"]
KEYS = [JUDGE_KEY, "wearline/c1/*/verdict", "wearline/c1/judge/*", "wearline/c1/**", "wearline/*/judge/verdict", "**"]


@pytest.mark.parametrize("forger", FORGERS)
def test_a_forged_verdict_reaches_nobody(
    running_router: CellSettings, join: Join, pretend: Pretend, certificates: Path, forger: str
) -> None:
    fieldbus, judge, heard = join("fieldbus"), join("judge"), Heard()
    fieldbus.subscribe(VERDICTS, heard)
    judge.publish(VERDICT.replace(reason="first"))
    heard.wait_for(bool)
    name, folder = ("judge", certificates / "neighbour") if forger == "judge of c2" else (forger, certificates)
    session = pretend(name, folder)
    header, payload = encode(VERDICT.replace(reason="forged"))
    for key in KEYS:
        for priority in (zenoh.Priority.DATA_HIGH, zenoh.Priority.REAL_TIME):
            session.put(key, payload, attachment=header, priority=priority)
    round_trip(session)
    judge.publish(VERDICT.replace(reason="last"))
    assert [v.reason for v in heard.wait_for(lambda items: items[-1].reason == "last")] == ["first", "last"]


def round_trip(session: zenoh.Session) -> None:
    """What was sent before has been dealt with by the router once this question has ended."""
    list(session.get(alive_key("c1", "nobody"), timeout=0.3))


def test_the_same_verdict_from_judge_arrives(
    running_router: CellSettings, join: Join, pretend: Pretend, certificates: Path
) -> None:
    """The forgeries above fail for who sends them, not for how."""
    heard = Heard()
    join("fieldbus").subscribe(VERDICTS, heard)
    session = pretend("judge", certificates)
    header, payload = encode(VERDICT.replace(reason="genuine"))
    until(lambda: session.put(JUDGE_KEY, payload, attachment=header) is None and bool(heard.items))
    assert heard.items[0].reason == "genuine"


def test_a_forged_sign_of_life_reaches_nobody(
    running_router: CellSettings, join: Join, pretend: Pretend, certificates: Path
) -> None:
    alive = Heard()
    join("fieldbus").watch_alive(alive)
    session = pretend("hmi", certificates)
    tokens = [session.liveliness().declare_token(alive_key("c1", name, "1-ab")) for name in ("judge", "hmi")]
    # Its own is passed on, and came later.
    alive.wait_for(bool)
    assert alive.items == [("hmi", frozenset({"1-ab"}))]
    del tokens


def test_a_forged_answer_reaches_nobody(
    running_router: CellSettings, join: Join, pretend: Pretend, certificates: Path
) -> None:
    from wearline.topics import RECIPE_LIST

    session = pretend("capture", certificates)
    header, payload = encode(answered(RECIPE_LIST))
    asked = Heard()

    def answer(query: zenoh.Query) -> None:
        asked(query)
        query.reply(query.key_expr, payload, attachment=header)

    queryable = session.declare_queryable(RECIPE_LIST.key("c1"), answer)
    round_trip(session)
    with pytest.raises(BusError, match="nobody answers"):
        join("hmi").ask(RECIPE_LIST, m.Ping(), timeout_s=0.5)
    assert asked.items == []
    del queryable


def test_only_those_in_the_table_may_command(
    running_router: CellSettings, join: Join, pretend: Pretend, certificates: Path
) -> None:
    from wearline.topics import DO_MEASURE

    fieldbus, asked = join("fieldbus"), Heard()

    def obey(question: m.DoMeasure) -> m.Message:
        asked(question)
        return m.Done(ok=True)

    fieldbus.answer(DO_MEASURE, obey)
    hmi = join("hmi")
    until(lambda: obeyed(hmi))
    before = len(asked.items)
    session = pretend("capture", certificates)
    header, payload = encode(m.DoMeasure())
    for key in (DO_MEASURE.key("c1"), "wearline/c1/*/do/measure", "wearline/c1/**"):
        replies = list(session.get(key, payload=payload, attachment=header, timeout=0.3))
        assert not any(reply.ok for reply in replies), key
    assert len(asked.items) == before


def obeyed(bus: Bus) -> bool:
    from wearline.topics import DO_MEASURE

    try:
        return bus.ask(DO_MEASURE, m.DoMeasure(), timeout_s=DEADLINE_S) == m.Done(ok=True)
    except BusError:
        return False


def test_nobody_enters_without_a_certificate_of_the_cell(
    running_router: CellSettings, pretend: Pretend, certificates: Path
) -> None:
    with pytest.raises(zenoh.ZError):
        pretend("judge", certificates / "c2")
    settings = {**_plain_settings("client"), "connect/timeout_ms": 0}
    port = running_router.router.endpoint.rpartition(":")[2]
    with pytest.raises(zenoh.ZError):
        zenoh.open(_config({**settings, "connect/endpoints": [f"tcp/127.0.0.1:{port}"]}))
    bare = {"root_ca_certificate": str(certificates / "authority.pem"), "enable_mtls": False}
    with pytest.raises(zenoh.ZError):
        zenoh.open(
            _config({**settings, "transport/link/tls": bare, "connect/endpoints": [running_router.router.endpoint]})
        )


# --- the table and the settings ---


def test_the_rules_deny_by_default_and_name_one_cell() -> None:
    rules = access_control("c7")
    assert rules["enabled"] is True
    assert rules["default_permission"] == "deny"
    for rule in rules["rules"]:
        assert rule["permission"] == "allow"
        for key in rule["key_exprs"]:
            assert key.startswith("wearline/c7/"), key
    said = [rule for rule in rules["rules"] if "put" in rule["messages"] and "ingress" in rule["flows"]]
    for rule in said:
        service = rule["id"].removesuffix("-says")
        assert all(key.startswith(f"wearline/c7/{service}/") for key in rule["key_exprs"])
    assert len(said) == len(SERVICES)


def test_the_table_allows_what_the_services_do() -> None:
    """A service that hears or asks something new must be let in, or it would work everywhere but in a plant."""
    import wearline.topics as table

    known: dict[str, Topic | Query] = {n: v for n, v in vars(table).items() if isinstance(v, (Topic, Query))}
    for service in SERVICES:
        allowed = {*HEARS[service], *ASKS[service]}
        for path in (ROOT / "services" / service).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not (isinstance(node, ast.ImportFrom) and node.module == "wearline.topics"):
                    continue
                for alias in node.names:
                    used = known.get(alias.name)
                    own = used is not None and service == (used.publisher if isinstance(used, Topic) else used.answerer)
                    assert used is None or own or used in allowed, f"{path.name} uses {alias.name}: wearline/access.py"


def test_certificates_and_addresses_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("cell: c1\ndata_dir: .\nrouter: {endpoint: tls/router:7447}\n")
    with pytest.raises(ConfigError, match="tls/router:7447 and the setting 'tls' go together"):
        load_cell(path)
    path.write_text(
        "cell: c1\ndata_dir: .\nrouter: {endpoint: tcp/router:7447, tls: {authority: ca/a.pem, folder: ca}}\n"
    )
    with pytest.raises(ConfigError, match="tcp/router:7447 and the setting 'tls' go together"):
        load_cell(path)
    path.write_text(
        "cell: c1\ndata_dir: .\nrouter: {endpoint: tls/router:7447, tls: {authority: ca/a.pem, folder: ca}}\n"
    )
    cell = load_cell(path)
    assert cell.router.tls is not None
    assert cell.router.tls.authority == tmp_path / "ca" / "a.pem"
    with pytest.raises(ConfigError, match=r"a.pem: cannot be read; issue it"):
        Bus("c1", "judge", cell.router.endpoint, cell.router.tls)
    assert main(["router", "--config", str(path)]) == 2
    assert "issue it, or correct router.tls" in capsys.readouterr().err


def test_zenohd_gets_the_same_settings(cell: CellSettings, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tls = cell.router.tls
    assert tls is not None
    path = tmp_path / "cell.yaml"
    path.write_text(
        f"cell: c1\ndata_dir: .\nrouter: {{endpoint: '{cell.router.endpoint}', "
        f"tls: {{authority: '{tls.authority}', folder: '{tls.folder}'}}}}\n"
    )
    assert main(["router", "--config", str(path), "--zenohd"]) == 0
    printed: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert printed == router_settings(cell)
    assert printed["access_control"]["default_permission"] == "deny"
    zenoh.open(zenoh.Config.from_json5(json.dumps(printed))).close()  # type: ignore[no-untyped-call]
    open_router(cell).close()  # type: ignore[no-untyped-call]
