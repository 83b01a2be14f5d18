"""The server that records a run: the one that is named, the embedded one, and a temporary one where that cannot be."""

import os
import resource
import sqlite3
from unittest.mock import Mock

import httpx
import pytest
from prefect.settings import (
    PREFECT_API_DATABASE_CONNECTION_URL,
    PREFECT_API_URL,
    PREFECT_HOME,
    temporary_settings,
)

from tracklake.pipeline.orchestration import prefect_home, server
from tracklake.schemas.errors import TracklakeError


@pytest.fixture
def home(tmp_path):
    """A home for Prefect in this process, without a server."""
    folder = tmp_path / "home"
    folder.mkdir()
    url = f"sqlite+aiosqlite:///{folder / 'prefect.db'}"
    changed = {PREFECT_HOME: folder, PREFECT_API_DATABASE_CONNECTION_URL: url, PREFECT_API_URL: None}
    with temporary_settings(changed):
        yield folder


@pytest.fixture
def embed(monkeypatch) -> Mock:
    """Stands in for the embedded server: returns the database that it would use as its address."""
    stand_in = Mock(side_effect=lambda: PREFECT_API_DATABASE_CONNECTION_URL.value())
    monkeypatch.setattr(server, "_embed_server", stand_in)
    monkeypatch.setattr(server, "find_home_fault", lambda: None)
    monkeypatch.setattr(server, "LOCK_WAIT_S", 0.05)
    return stand_in


def write_database(home) -> sqlite3.Connection:
    connection = sqlite3.connect(home / "prefect.db", isolation_level=None)
    connection.execute("CREATE TABLE runs (name TEXT)")
    connection.executemany("INSERT INTO runs VALUES (?)", [("x" * 1000,)] * 100)
    return connection


@pytest.mark.usefixtures("embed")
def test_a_database_that_can_be_used_is_used(home):
    assert server._start_embedded() == (f"sqlite+aiosqlite:///{home / 'prefect.db'}", [])
    write_database(home).close()
    assert server._start_embedded() == (f"sqlite+aiosqlite:///{home / 'prefect.db'}", [])


def lock(home):
    connection = write_database(home)
    connection.execute("BEGIN EXCLUSIVE")
    return connection


def overwrite_pages(home):
    write_database(home).close()
    with (home / "prefect.db").open("r+b") as file:
        file.seek(8192)
        file.write(b"\xff" * 8192)


DAMAGES = {
    "locked": (lock, "database is locked"),
    "garbage": (lambda home: (home / "prefect.db").write_text("garbage" * 100), "file is not a database"),
    "folder": (lambda home: (home / "prefect.db").mkdir(), "unable to open database file"),
    "pages": (overwrite_pages, "damaged: "),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.usefixtures("embed")
def test_a_temporary_database_stands_in_and_is_named(home, damage):
    damage_it, reason = DAMAGES[damage]
    held = damage_it(home)
    address, (note,) = server._start_embedded()
    folder = prefect_home.make_temporary_folder()
    assert address == f"sqlite+aiosqlite:///{folder / 'prefect.db'}"
    assert f"{home / 'prefect.db'}: {reason}" in note
    assert str(folder) in note
    if isinstance(held, sqlite3.Connection):
        held.close()


@pytest.mark.usefixtures("home")
def test_a_database_on_which_the_server_does_not_start_is_left_too(embed):
    embed.side_effect = [server.PrefectError("no revision abc"), "the second"]
    address, (note,) = server._start_embedded()
    assert (address, embed.call_count) == ("the second", 2)
    assert "no revision abc" in note


@pytest.mark.usefixtures("home")
def test_a_database_of_a_users_own_is_not_replaced(embed):
    embed.side_effect = server.PrefectError("no connection")
    with (
        temporary_settings({PREFECT_API_DATABASE_CONNECTION_URL: "postgresql+asyncpg://db/prefect"}),
        pytest.raises(server.PrefectError, match="no connection"),
    ):
        server._start_embedded()


@pytest.mark.parametrize("place", ["file/home", "file"])
def test_a_home_that_cannot_be_written_to_has_a_reason(tmp_path, monkeypatch, place):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path / place))
    fault = prefect_home.find_home_fault.__wrapped__()
    assert str(tmp_path / place) in fault
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path / "new"))
    assert prefect_home.find_home_fault.__wrapped__() is None


def test_a_home_that_cannot_be_written_to_is_replaced_before_prefect_is_imported(monkeypatch):
    monkeypatch.setenv("PREFECT_HOME", "/dev/null/home")
    monkeypatch.setattr(prefect_home, "find_home_fault", lambda: "PREFECT_HOME: no")
    monkeypatch.setattr(prefect_home, "import_module", lambda _name: os.environ["PREFECT_HOME"])
    assert prefect_home.import_flows() == str(prefect_home.make_temporary_folder())


@pytest.mark.parametrize("address", ["http://127.0.0.1:9/api", "nonsense"])
@pytest.mark.usefixtures("home")
def test_an_address_without_a_server_is_named(address):
    with (
        temporary_settings({PREFECT_API_URL: address}),
        pytest.raises(server.PrefectError, match=f"no Prefect server answers at {address}") as refused,
        server.use_server(),
    ):
        raise AssertionError("never gets here")
    assert "unset PREFECT_API_URL" in str(refused.value)


@pytest.mark.usefixtures("home")
def test_an_empty_address_is_none(monkeypatch):
    monkeypatch.setattr(server, "_start_embedded", lambda: ("http://here/api", []))
    with temporary_settings({PREFECT_API_URL: ""}):
        with pytest.raises(server.PrefectError, match="PREFECT_API_URL is not set"):
            server.require_server()
        with server.use_server():
            assert PREFECT_API_URL.value() == "http://here/api"


@pytest.mark.usefixtures("home")
def test_a_server_that_breaks_off_is_a_message_and_a_wrong_request_is_a_bug(monkeypatch):
    monkeypatch.setattr(server, "_start_embedded", lambda: ("http://here/api", []))
    request = httpx.Request("POST", "http://here/api")
    with pytest.raises(server.PrefectError, match="broke off \\(database or disk is full\\)"), server.use_server():
        raise httpx.HTTPStatusError("database or disk is full", request=request, response=httpx.Response(500))
    with pytest.raises(httpx.HTTPStatusError), server.use_server():
        raise httpx.HTTPStatusError("no such field", request=request, response=httpx.Response(422))


@pytest.mark.usefixtures("home")
def test_a_server_that_does_not_start_says_why_and_leaves_no_socket(monkeypatch, recwarn):
    async def fail(_scope, _receive, send):
        await send({"type": "lifespan.startup.failed", "message": "Traceback ...\nValueError: no such revision"})

    monkeypatch.setattr("prefect.server.api.server.create_app", lambda **_: fail)
    with pytest.raises(server.PrefectError, match="did not start \\(ValueError: no such revision\\)"):
        server._embed_server()
    assert [str(warning.message) for warning in recwarn if warning.category is ResourceWarning] == []


@pytest.mark.parametrize(("hard", "raised"), [(24, None), (1000, 1000), (resource.RLIM_INFINITY, 4096)])
def test_too_few_open_files_are_refused_and_few_are_raised(monkeypatch, hard, raised):
    changed = []
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (24, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _which, limits: changed.append(limits))
    if raised is None:
        with pytest.raises(TracklakeError, match=r"may open 24 files at once; expected 128 or more.*ulimit -n 1024"):
            prefect_home.import_flows()
    else:
        prefect_home._provide_descriptors()
        assert changed == [(raised, hard)]
