"""Small fakes of Google Cloud Storage and Azure Blob Storage: the few requests that a lake makes of them.

They are written after the published protocols, and answer obstore's own requests. They show that conditions, tags,
lists and deletions fit together on our side; not that a cloud does as its documentation says, nor that it lets us in.
Files that are sent in several pieces are left out.
"""

import email
import itertools
import json
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

import pytest
from object_stores import forget_clouds

TIME = "Mon, 23 Nov 2026 06:00:00 GMT"
GOOGLE_ACCOUNT = {"disable_oauth": True, "client_email": "", "private_key": "", "private_key_id": ""}
"""A key with which obstore sends no signature."""
PAGE = 3
"""Objects in one answer to a list, so that small lists are paged, too."""


class Cloud(BaseHTTPRequestHandler):
    """What both have in common: objects with versions, written on conditions. Each server has a subclass of its own."""

    protocol_version = "HTTP/1.1"
    objects: dict[str, tuple[bytes, int]]
    guard: threading.Lock
    versions: Iterator[int]

    def answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def read(self) -> tuple[str, dict[str, str], bytes]:
        """Key below the bucket, query and body of a request."""
        parts = urlsplit(self.path)
        query = {name: values[0] for name, values in parse_qs(parts.query, keep_blank_values=True).items()}
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        return unquote(parts.path).partition("/bucket/")[2], query, body

    def describe(self, version: int) -> dict[str, str]:
        return {"ETag": f'"e{version}"', "Last_Modified": TIME, "x_goog_generation": str(version)}

    def is_met(self, version: int | None) -> bool:
        raise NotImplementedError

    def list(self, query: dict[str, str], after: str) -> tuple[list[str], str]:
        """Return the names of a page, and the last of them if there are more."""
        names = sorted(name for name in self.objects if name.startswith(query.get("prefix", "")) and name > after)
        return names[:PAGE], names[PAGE - 1] if len(names) > PAGE else ""

    def do_PUT(self) -> None:
        key, _, body = self.read()
        with self.guard:
            kept = self.objects.get(key)
            if not self.is_met(kept and kept[1]):
                return self.answer(409 if self.headers.get("If-None-Match") else 412)
            version = next(self.versions)
            self.objects[key] = (body, version)
        return self.answer(201, **self.describe(version))

    def do_GET(self) -> None:
        key, query, _ = self.read()
        if not key:
            return self.answer(200, self.render(query), Content_Type="application/xml")
        if key not in self.objects:
            return self.answer(404)
        body, version = self.objects[key]
        return self.answer(200, body, **self.describe(version))

    def render(self, query: dict[str, str]) -> bytes:
        raise NotImplementedError

    def do_DELETE(self) -> None:
        self.answer(204 if self.objects.pop(self.read()[0], None) else 404)

    def log_message(self, *_message: object) -> None:
        pass


class Google(Cloud):
    """XML API: a condition is the generation of an object, 0 where there must be none."""

    def is_met(self, version: int | None) -> bool:
        expected = self.headers.get("x-goog-if-generation-match")
        return expected is None or int(expected) == (version or 0)

    def render(self, query: dict[str, str]) -> bytes:
        names, following = self.list(query, query.get("continuation-token", ""))
        found = "".join(
            f"<Contents><Key>{escape(name)}</Key><LastModified>2026-11-23T06:00:00.000Z</LastModified>"
            f'<ETag>"e{self.objects[name][1]}"</ETag><Size>{len(self.objects[name][0])}</Size></Contents>'
            for name in names
        )
        more = f"<NextContinuationToken>{escape(following)}</NextContinuationToken>" if following else ""
        return f"<ListBucketResult>{found}{more}</ListBucketResult>".encode()


class Azure(Cloud):
    """Blob service: conditions are ETags; several deletions are parts of one request."""

    def is_met(self, version: int | None) -> bool:
        if self.headers.get("If-None-Match") == "*":
            return version is None
        expected = self.headers.get("If-Match")
        return expected is None or expected == f'"e{version}"'

    def render(self, query: dict[str, str]) -> bytes:
        names, following = self.list(query, query.get("marker", ""))
        found = "".join(
            f"<Blob><Name>{escape(name)}</Name><Properties><Last-Modified>{TIME}</Last-Modified>"
            f"<Content-Length>{len(self.objects[name][0])}</Content-Length><Etag>e{self.objects[name][1]}</Etag>"
            "<Content-Type>x/y</Content-Type></Properties></Blob>"
            for name in names
        )
        more = f"<NextMarker>{escape(following)}</NextMarker>"
        return f"<EnumerationResults><Blobs>{found}</Blobs>{more}</EnumerationResults>".encode()

    def do_POST(self) -> None:
        _, _, body = self.read()
        parts = email.message_from_bytes(b"Content-Type: " + self.headers["Content-Type"].encode() + b"\r\n\r\n" + body)
        answers = b""
        for part in parts.walk():
            found = re.match(r"DELETE \S*?/bucket/(\S+) HTTP", str(part.get_payload()))
            if found:
                status = "202 Accepted" if self.objects.pop(unquote(found[1]), None) else "404 Not Found"
                answers += (
                    f"--answers\r\nContent-Type: application/http\r\nContent-ID: {part['Content-ID']}\r\n\r\n"
                    f"HTTP/1.1 {status}\r\nx-ms-error-code: BlobNotFound\r\n\r\n\r\n"
                ).encode()
        self.answer(202, answers + b"--answers--\r\n", Content_Type="multipart/mixed; boundary=answers")


@pytest.fixture(params=[Google, Azure], ids=["google", "azure"])
def cloud(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of an empty folder on a fake of either cloud, to which the environment leads."""
    forget_clouds(monkeypatch)
    facts = {"objects": {}, "guard": threading.Lock(), "versions": itertools.count(1)}
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Own", (request.param,), facts))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{server.server_port}"
    own = {
        Google: {"GOOGLE_BASE_URL": url, "GOOGLE_SERVICE_ACCOUNT_KEY": json.dumps(GOOGLE_ACCOUNT)},
        Azure: {"AZURE_STORAGE_ENDPOINT": url, "AZURE_STORAGE_ACCOUNT_NAME": "me", "AZURE_SKIP_SIGNATURE": "true"},
    }
    for name, value in own[request.param].items():
        monkeypatch.setenv(name, value)
    yield "gs://bucket/lake" if request.param is Google else "az://bucket/lake"
    server.shutdown()
    server.server_close()
    thread.join()
