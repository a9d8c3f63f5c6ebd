"""The page's files: compressed if the browser accepts that, and not sent again while unchanged."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.cockpit import FakeDrone, cockpit, fake_fleet
from tests.support.testclient import TestClient

SCRIPT = b"export const seen = 1;\n" * 200
PAGE = '<script src="/static/cockpit.js"></script><link href="/static/gone.css">'
FOR_GOOD = "private, max-age=31536000, immutable"


@pytest.fixture
def static(tmp_path: Path) -> Path:
    for name, content in {
        "cockpit.js": SCRIPT,
        "scene-ABCD1234.js": SCRIPT,
        "small.js": b"1",
        "index.html": PAGE.encode(),
    }.items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


@pytest.fixture
def client(static: Path) -> Iterator[TestClient]:
    with cockpit(fake_fleet({"alpha": FakeDrone()}), static=static) as client:
        yield client


def script(client: TestClient) -> str:
    return str(client.get("/").text.split('"')[1])


def test_files_are_compressed_for_browsers_that_accept_it(client: TestClient) -> None:
    packed = client.get("/static/cockpit.js", headers={"accept-encoding": "br, gzip"})
    assert (packed.headers["content-encoding"], packed.content) == ("gzip", SCRIPT)
    assert int(packed.headers["content-length"]) == len(gzip.compress(SCRIPT, 9)) < len(SCRIPT) / 10
    plain = client.get("/static/cockpit.js", headers={"accept-encoding": "identity"})
    assert ("content-encoding" in plain.headers, plain.content, plain.headers["vary"]) == (
        False,
        SCRIPT,
        "Accept-Encoding",
    )
    assert packed.headers["etag"] != plain.headers["etag"]
    assert "content-encoding" not in client.get("/static/small.js").headers
    assert "javascript" in packed.headers["content-type"]


def test_files_named_by_content_are_cached_forever(client: TestClient, static: Path) -> None:
    address = script(client)
    assert address.startswith("/static/cockpit.js?v=")
    for kept in (address, "/static/scene-ABCD1234.js"):
        assert client.get(kept).headers["cache-control"] == FOR_GOOD, kept
    for asked in ("/", "/static/cockpit.js", "/static/cockpit.js?v=0123456789abcdef", "/static/small.js?v="):
        assert client.get(asked).headers["cache-control"] == "no-cache", asked
    (static / "cockpit.js").write_bytes(SCRIPT + b"//")
    assert script(client) != address, "another content has another address"
    assert client.get(script(client)).content == SCRIPT + b"//"


def test_unchanged_files_are_not_sent_again(client: TestClient) -> None:
    tag = client.get("/static/cockpit.js").headers["etag"]
    again = client.get("/static/cockpit.js", headers={"if-none-match": tag})
    assert (again.status_code, again.content) == (304, b"")
    assert client.get("/static/cockpit.js", headers={"if-none-match": '"other"'}).status_code == 200


@pytest.mark.parametrize("path", ["gone.js", "..%2Findex.html", "%00", "a" * 300, ""])
def test_missing_files_are_not_found(client: TestClient, path: str) -> None:
    assert client.get(f"/static/{path}").status_code in (400, 404)


def test_the_page_keeps_what_it_cannot_find(client: TestClient) -> None:
    assert '"/static/gone.css"' in client.get("/").text
