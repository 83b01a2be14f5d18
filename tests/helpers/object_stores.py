"""An S3 server on this machine for tests, and buckets in it."""

import json
import os
import re
import socket
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

KEY_ID, SECRET = "AKIAEXAMPLEOFTESTS", "a/secret/that/must/be/written/nowhere"
HEEDLESS, FORBIDDEN, BUSY, FORGETFUL = "heedless", "forbidden", "busy", "forgetful"
"""Beginnings of the names of buckets: those ignore the conditions of writes, refuse everything, never have time,
or lose the answer to each write except of tables: a client repeats it, and gets the second answer."""
REFUSAL = (
    "<Error><Code>SignatureDoesNotMatch</Code><Message>no</Message>"
    f"<AWSAccessKeyId>{KEY_ID}</AWSAccessKeyId><StringToSign>{SECRET}</StringToSign></Error>"
)
"""Answer that repeats credentials, as S3's repeats the key's id."""


@dataclass(frozen=True)
class ObjectStoreServer:
    """A server and the environment of a process that uses it."""

    url: str

    @property
    def environment(self) -> dict[str, str]:
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": KEY_ID,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_REGION": "eu-north-1",
        }

    def make_bucket(self, kind: str = "bucket") -> str:
        """Make a bucket and return the address of a folder in it."""
        name = f"{kind}-{uuid.uuid4().hex}"
        if kind not in (FORBIDDEN, BUSY):  # by a plain request: the environment stays, which other threads may read
            urlopen(Request(f"{self.url}/{name}", method="PUT")).close()
        return f"s3://{name}/lake"


def _make_application() -> Callable[..., Iterable[bytes]]:
    from moto.server import DomainDispatcherApplication, create_backend_app

    moto = DomainDispatcherApplication(create_backend_app)
    one_at_a_time = threading.Lock()  # moto looks at a condition first, and writes then
    repeated = set()

    def answer(request: dict[str, object], start: Callable[..., object]) -> Iterable[bytes]:
        bucket = str(request["PATH_INFO"]).lstrip("/")
        if bucket.startswith(FORBIDDEN):
            start("403 Forbidden", [("Content-Type", "application/xml")])
            return [REFUSAL.encode()]
        if bucket.startswith(BUSY):
            start("503 Slow Down", [("Content-Type", "application/xml")])
            return [b"<Error><Code>SlowDown</Code></Error>"]
        if bucket.startswith(HEEDLESS):
            for name in ("HTTP_IF_MATCH", "HTTP_IF_NONE_MATCH"):
                request.pop(name, None)
        with one_at_a_time:
            answered = moto(request, start)
        if bucket.startswith(FORGETFUL) and request["REQUEST_METHOD"] == "PUT" and "/lake/" in bucket:
            write = (re.sub("[0-9a-f]{64}", "", bucket), request.get("HTTP_IF_MATCH"))  # another try has another shard
            if ".parquet" not in bucket and write not in repeated:
                repeated.add(write)
                request["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
                raise ConnectionError("the answer is lost")
        return answered

    return answer


@pytest.fixture(scope="session")
def object_store_server() -> Iterator[ObjectStoreServer]:
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        protocol_version = "HTTP/1.1"

        def log(self, *_message: object) -> None:
            pass

    server = make_server("127.0.0.1", 0, _make_application(), threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield ObjectStoreServer(f"http://127.0.0.1:{server.server_port}")
    server.shutdown()
    server.server_close()
    thread.join()


def forget_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take what the machine's environment says of object stores out of it."""
    for name in [name for name in os.environ if re.match("(AWS|GOOGLE|AZURE)_", name)]:
        monkeypatch.delenv(name)


@pytest.fixture
def bucket(object_store_server: ObjectStoreServer, monkeypatch: pytest.MonkeyPatch) -> str:
    """The address of an empty folder on an object store, which the environment leads to."""
    forget_clouds(monkeypatch)
    for name, value in object_store_server.environment.items():
        monkeypatch.setenv(name, value)
    return object_store_server.make_bucket()


@dataclass(frozen=True)
class Role:
    """A server of a machine's role: what a process needs to find it, and the programs that asked it for credentials."""

    environment: dict[str, str]
    asked: list[str]


@pytest.fixture
def role(tmp_path: Path) -> Iterator[Role]:
    asked: list[str] = []
    answer = {"AccessKeyId": KEY_ID, "SecretAccessKey": SECRET, "Token": "token", "Expiration": "2099-01-01T00:00:00Z"}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.headers["User-Agent"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(answer).encode())

        def log_message(self, *_message: object) -> None:
            pass

    (tmp_path / "token").write_text("token")
    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{server.server_port}/"
    names = ("AWS_CONTAINER_CREDENTIALS_FULL_URI", "AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE")
    yield Role(dict(zip(names, (url, str(tmp_path / "token")), strict=True)), asked)
    server.shutdown()
    server.server_close()
    thread.join()
