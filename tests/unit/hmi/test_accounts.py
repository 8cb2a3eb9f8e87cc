"""Users, sessions, tokens and audit on disk."""

from __future__ import annotations

import sqlite3
import stat
from pathlib import Path

import pytest

from wearline.errors import RecordError, UsageError
from wearline_hmi.core.passwords import FREE_TRIES
from wearline_hmi.core.rights import Role
from wearline_hmi.drivers import accounts as a
from wearline_hmi.drivers.accounts import Accounts, digest

IDLE_S, SESSION_S = 600.0, 3600.0


class Clock:
    def __init__(self) -> None:
        self.now_s = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def accounts(tmp_path: Path, clock: Clock) -> Accounts:
    found = Accounts(tmp_path / "accounts.db", IDLE_S, SESSION_S, clock)
    found.add("Ada", Role.ADMINISTRATOR, "hash", must_change=False)
    return found


def session(accounts: Accounts, name: str = "Ada") -> str:
    user = accounts.user(name)
    assert user is not None
    return digest(accounts.open_session(user, "10.0.0.1"))


def test_a_file_of_its_own_that_nobody_else_may_read_and_that_holds_no_token(
    tmp_path: Path, accounts: Accounts
) -> None:
    user = accounts.user("ada")
    assert user is not None
    token, api = accounts.open_session(user, "x"), accounts.add_token("grafana", "Ada")
    accounts.close()
    path = tmp_path / "accounts.db"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    content = b"".join(p.read_bytes() for p in tmp_path.iterdir())
    assert token.encode() not in content
    assert api.encode() not in content


def test_all_of_it_outlives_a_restart(tmp_path: Path, accounts: Accounts, clock: Clock) -> None:
    opened = session(accounts)
    accounts.note("Ada", "x", "log in")
    accounts.close()
    again = Accounts(tmp_path / "accounts.db", IDLE_S, SESSION_S, clock)
    user = again.session_user(opened, is_active=False)
    assert user is not None
    assert user.name == "Ada"
    assert [entry.deed for entry in again.audit()] == ["log in"]


def test_a_session_ends_when_nothing_was_done_and_polling_is_nothing(accounts: Accounts, clock: Clock) -> None:
    opened = session(accounts)
    clock.now_s += IDLE_S - 1
    assert accounts.session_user(opened, is_active=True) is not None
    for _ in range(10):
        clock.now_s += IDLE_S / 10
        assert accounts.session_user(opened, is_active=False) is not None
    clock.now_s += 1
    assert accounts.session_user(opened, is_active=False) is None
    assert accounts.session_user(opened, is_active=True) is None


def test_a_session_ends_after_its_time_however_busy(accounts: Accounts, clock: Clock) -> None:
    opened = session(accounts)
    for _ in range(7):
        clock.now_s += IDLE_S - 90
        assert accounts.session_user(opened, is_active=True) is not None
    clock.now_s += 100
    assert accounts.session_user(opened, is_active=True) is None


def test_sessions_are_unlike_and_end_one_by_one(accounts: Accounts) -> None:
    user = accounts.user("Ada")
    assert user is not None
    tokens = {accounts.open_session(user, "x") for _ in range(20)}
    assert len(tokens) == 20
    assert all(len(token) >= 43 for token in tokens), "256 bits"
    one, other = (digest(token) for token in list(tokens)[:2])
    accounts.close_session(one)
    assert accounts.session_user(one, is_active=False) is None
    assert accounts.session_user(other, is_active=False) is not None


def test_another_password_ends_all_other_sessions(accounts: Accounts) -> None:
    own, other = session(accounts), session(accounts)
    accounts.set_secret("Ada", "new", must_change=True, keep_session=own)
    user = accounts.session_user(own, is_active=False)
    assert user is not None
    assert user.must_change
    assert accounts.session_user(other, is_active=False) is None


def test_a_role_rules_open_sessions_at_once_and_a_removed_user_has_none(accounts: Accounts) -> None:
    accounts.add("Mats", Role.MAINTENANCE, "hash", must_change=False)
    opened = session(accounts, "Mats")
    accounts.set_role("mats", Role.OPERATOR)
    user = accounts.session_user(opened, is_active=False)
    assert user is not None
    assert user.role is Role.OPERATOR
    accounts.remove("MATS")
    assert accounts.session_user(opened, is_active=False) is None


def test_the_last_administrator_stays(accounts: Accounts) -> None:
    with pytest.raises(UsageError, match="last administrator"):
        accounts.remove("Ada")
    with pytest.raises(UsageError, match="last administrator"):
        accounts.set_role("Ada", Role.OPERATOR)
    accounts.add("Eve", Role.ADMINISTRATOR, "hash", must_change=False)
    accounts.remove("Ada")
    assert [user.name for user in accounts.users()] == ["Eve"]


@pytest.mark.parametrize("name", ["", "  ", "x" * 41, "a\nb", "ada"])
def test_bad_and_taken_names_are_refused(accounts: Accounts, name: str) -> None:
    with pytest.raises(UsageError):
        accounts.add(name, Role.OPERATOR, "hash", must_change=False)


def test_nobody_is_made_a_viewer_and_there_is_one_first(accounts: Accounts) -> None:
    with pytest.raises(UsageError):
        accounts.add("V", Role.VIEWER, "hash", must_change=False)
    with pytest.raises(UsageError):
        accounts.set_role("Ada", Role.VIEWER)
    with pytest.raises(UsageError):
        accounts.add("B", Role.ADMINISTRATOR, "hash", must_change=False, only_first=True)
    with pytest.raises(UsageError, match="no such user"):
        accounts.remove("nobody")


def test_wrong_passwords_make_this_sender_wait_and_no_other(accounts: Accounts, clock: Clock) -> None:
    for _ in range(FREE_TRIES + 3):
        accounts.note_failure("ada", "10.0.0.1")
    assert accounts.must_wait_s("ADA ", "10.0.0.1") == 4.0
    assert accounts.must_wait_s("ada", "10.0.0.2") == 0.0, "the operator at the press still comes in"
    assert accounts.must_wait_s("nobody", "10.0.0.1") == 0.0
    clock.now_s += 4.0
    assert accounts.must_wait_s("ada", "10.0.0.1") == 0.0
    accounts.note_success("ada", "10.0.0.1")
    accounts.note_failure("ada", "10.0.0.1")
    assert accounts.must_wait_s("ada", "10.0.0.1") == 0.0


def test_unknown_names_wait_like_known_ones_and_many_names_make_the_sender_wait(accounts: Accounts) -> None:
    for _ in range(FREE_TRIES + 1):
        accounts.note_failure("nobody", "10.0.0.1")
        accounts.note_failure("ada", "10.0.0.2")
    assert accounts.must_wait_s("nobody", "10.0.0.1") == accounts.must_wait_s("ada", "10.0.0.2") == 1.0
    for number in range(a.SENDER_TRIES + FREE_TRIES + 1):
        accounts.note_failure(f"guess {number}", "10.0.0.9")
    assert accounts.must_wait_s("never tried", "10.0.0.9") == 1.0


def test_tokens_are_shown_once_and_refused_when_removed(accounts: Accounts) -> None:
    token = accounts.add_token("grafana", "Ada")
    assert accounts.token_name(token) == "grafana"
    assert accounts.token_name(token + "x") is None
    with pytest.raises(UsageError):
        accounts.add_token("grafana", "Ada")
    accounts.remove_token("grafana")
    assert accounts.token_name(token) is None


def test_the_audit_log_is_searched_newest_first_and_bounded(
    accounts: Accounts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(a, "AUDIT_KEPT", 5)
    for number in range(9):
        accounts.note("Ada", "10.0.0.1", "set the mode", f"to 100%_{number}")
    assert [entry.detail for entry in accounts.audit()] == [f"to 100%_{n}" for n in (8, 7, 6, 5, 4)]
    assert [entry.detail for entry in accounts.audit(search="0%_7")] == ["to 100%_7"]
    assert accounts.audit(search="100x") == []


def test_a_broken_or_newer_file_is_said_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "broken.db"
    path.write_bytes(b"no database at all" * 100)
    with pytest.raises(RecordError, match=r"broken.db.*restore a backup"):
        Accounts(path, IDLE_S, SESSION_S)
    newer = tmp_path / "newer.db"
    with sqlite3.connect(newer) as db:
        db.execute("PRAGMA user_version=9")
    with pytest.raises(RecordError, match="newer version"):
        Accounts(newer, IDLE_S, SESSION_S)
