"""Starting and ending the cockpit: errors are reported, access is limited, and it ends with its parent."""

from __future__ import annotations

import asyncio
import builtins
import json
import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect as open_socket
from websockets.typing import Origin

from skyloop.client import connect
from skyloop.cockpit import Access, serve_cockpit, target_tracker, with_certificate
from skyloop.cockpit.__main__ import main
from skyloop.cockpit.addresses import bind
from skyloop.cockpit.child import CockpitProcess
from skyloop.cockpit.encoded_feed import _ENCODER, NICENESS
from skyloop.cockpit.testing import HeadlessPage, Pages
from skyloop.errors import LinkError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import FlightState
from tests.support.cockpit_page import PILOT, ask, log_in, served
from tests.support.systems import only_on

OBSERVER = "observer-token-0123456789"


@pytest.fixture(autouse=True)
def own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Folders for recordings, and a directory of sockets for this test alone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    path = tmp_path / "tokens"
    path.write_text(f"pilot {PILOT} ann\nobserver {OBSERVER}\n")
    path.chmod(0o600)
    return path


# Errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::"])
def test_access_beyond_loopback_is_restricted(host: str) -> None:
    with pytest.raises(UsageError, match="--token-file"):
        serve_cockpit(access=Access(host))


def test_contradicting_options_are_reported(tmp_path: Path) -> None:
    one = tmp_path / "one"
    for given, said in (
        ({"tls_cert": one}, "--tls-key"),
        ({"tls_key": one}, "--tls-cert"),
        ({"client_ca": one}, "need TLS"),
        ({"client_ca": one, "tls_cert": one, "tls_key": one, "token_file": one}, "not both"),
    ):
        with pytest.raises(UsageError, match=said):
            Access(**given)  # type: ignore[arg-type]


def test_unusable_files_are_reported(tmp_path: Path, tokens: Path) -> None:
    with pytest.raises(UsageError, match="can't be read"):
        serve_cockpit(access=Access(token_file=tmp_path / "gone"))
    with pytest.raises(UsageError, match=r"gone.* does not exist: make certificate and key"):
        serve_cockpit(access=Access(token_file=tokens, tls_cert=tmp_path / "gone", tls_key=tokens))
    with pytest.raises(UsageError, match="can't be used for TLS"):
        serve_cockpit(access=Access(token_file=tokens, tls_cert=tokens, tls_key=tokens))


def test_port_in_use() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {port} of 127.0.0.1 is in use"):
            serve_cockpit(["nobody-here"], port=port)


@pytest.mark.parametrize("port", [-1, 70000])
def test_an_invalid_port_is_refused(port: int) -> None:
    with pytest.raises(UsageError, match="can't be used"):
        serve_cockpit(port=port)


def test_no_such_proxy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownNameError, match="nobody-here"):
        serve_cockpit(["nobody-here"])
    assert main(["nobody-here"]) == 2
    assert "no proxy named 'nobody-here'" in capsys.readouterr().err


def test_missing_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".", maxsplit=1)[0] == "uvicorn":
            raise ImportError("No module named 'uvicorn'")
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "uvicorn", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingExtraError, match="skyloop install cockpit"):
        serve_cockpit()


@pytest.mark.process
def test_a_child_reports_why_it_did_not_start() -> None:
    with CockpitProcess("nobody-here") as page, pytest.raises(LinkError, match="no proxy named 'nobody-here'"):
        page.address()


# In this process ---------------------------------------------------------------------------------------------------


def on_loopback(address: str) -> str:
    """Return the address of a server that listens everywhere, as reached from this machine."""
    scheme, _, port = address.rpartition(":")
    return f"{scheme.partition('://')[0]}://127.0.0.1:{port}"


def test_pages_are_served_while_the_cockpit_warms_up(monkeypatch: pytest.MonkeyPatch, tokens: Path) -> None:
    """A separate thread imports the requirements of following: not the event loop's, which receives sticks."""
    begun, go_on = threading.Event(), threading.Event()

    def warm_up() -> None:
        begun.set()
        assert go_on.wait(30)

    monkeypatch.setattr(target_tracker, "warm_up", warm_up)
    try:
        with served(access=Access(token_file=tokens)) as address:
            assert begun.wait(10)
            assert ask(address, "/api/drones", OBSERVER) == []
    finally:
        go_on.set()


def test_tokens_on_the_network(tokens: Path) -> None:
    with served(access=Access("0.0.0.0", token_file=tokens)) as address:
        here = on_loopback(address)
        assert ask(here, "/api/session")["login"]
        assert ask(here, "/api/session", PILOT) == {"role": "pilot", "name": "ann", "login": True, "hint": ""}
        assert ask(here, "/api/drones", OBSERVER) == []
        for token in (None, "wrong-token-0123456789"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                ask(here, "/api/drones", token)
            assert refused.value.code == 401
            refused.value.close()
        with pytest.raises(LinkError, match="4401"):
            asyncio.run(HeadlessPage(here, "alpha").run())
        with pytest.raises(LinkError, match="4404"):
            asyncio.run(HeadlessPage(here, "alpha", token=OBSERVER).run())
        with pytest.raises(LinkError, match="did not open"), Pages(here, "alpha"):
            pass


@only_on("linux", reason="sessions end with the cockpit there")
def test_a_session_is_valid_after_a_restart(tokens: Path) -> None:
    with bind("127.0.0.1", 0) as free:
        port = free.getsockname()[1]
    access = Access(token_file=tokens)
    with served(access=access, port=port) as address:
        headers = {"content-type": "application/json", "origin": address}
        login = urllib.request.Request(f"{address}/api/login", json.dumps({"token": PILOT}).encode(), headers)
        with urllib.request.urlopen(login, timeout=5) as answer:
            cookie = answer.headers["set-cookie"].partition(";")[0]
    with served(access=access, port=port) as address:
        again = urllib.request.Request(f"{address}/api/session", headers={"cookie": cookie})
        with urllib.request.urlopen(again, timeout=5) as answer:
            assert json.load(answer)["name"] == "ann"


@only_on("linux", reason="no one tells there whose program connects")
def test_programs_of_this_user_are_admitted_without_a_token() -> None:
    with served() as address:
        assert ask(address, "/api/session") == {"role": "pilot", "name": "", "login": False, "hint": ""}
        request = urllib.request.Request(f"{address}/api/session", headers={"X-Forwarded-For": "192.0.2.1"})
        with urllib.request.urlopen(request, timeout=5) as answer:
            assert json.load(answer)["role"] == "pilot", "who is there is asked of the kernel, not of a header"


def test_its_metrics(capfd: pytest.CaptureFixture[str]) -> None:
    with served(metrics="0"):
        found = re.search(r"metrics: (http://\S+)", capfd.readouterr().err)
        assert found is not None
        with urllib.request.urlopen(found[1], timeout=5) as answer:
            assert b"skyloop_cockpit_unreachable 0.0" in answer.read()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, a server, a pilot, an observer, a person without a role, and a pilot of another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("makes certificates with openssl, which is not here")
    folder = tmp_path_factory.mktemp("tls")

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True, timeout=30)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for authority in ("ca", "other"):
        openssl(
            *("req", "-x509", *key, "-keyout", f"{authority}.key", "-out", f"{authority}.pem"),
            *("-subj", f"/CN={authority}", "-days", "2"),
        )
    (folder / "server.ext").write_text("subjectAltName=IP:127.0.0.1\n")
    for name, subject, authority in (
        ("server", "/CN=server", "ca"),
        ("pilot", "/OU=pilot/CN=Ann", "ca"),
        ("observer", "/OU=observer/CN=Bob", "ca"),
        ("nobody", "/OU=guest/CN=Eve", "ca"),
        ("stranger", "/OU=pilot/CN=Mallory", "other"),
    ):
        openssl("req", *key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", subject)
        extra = ("-extfile", "server.ext") if name == "server" else ()
        openssl(
            *("x509", "-req", "-in", f"{name}.csr", "-CA", f"{authority}.pem", "-CAkey", f"{authority}.key"),
            *("-out", f"{name}.pem", "-days", "2", "-CAcreateserial", *extra),
        )
    return folder


def visitor(folder: Path, name: str | None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    if name is not None:
        context.load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    return context


def test_certificates(certificates: Path) -> None:
    access = Access(
        "0.0.0.0",
        tls_cert=certificates / "server.pem",
        tls_key=certificates / "server.key",
        client_ca=certificates / "ca.pem",
    )
    with served(access=access) as address:
        assert address.startswith("https://")
        here = on_loopback(address)
        for name, person in (("pilot", ("pilot", "Ann")), ("observer", ("observer", "Bob")), ("nobody", (None, ""))):
            told = ask(here, "/api/session", tls=visitor(certificates, name))
            assert (told["role"], told["name"]) == person
        for context in (visitor(certificates, None), visitor(certificates, "stranger")):
            with pytest.raises(OSError, match=r"alert|certificate|closed|reset"):
                ask(here, "/api/session", tls=context)
        for name, code in (("nobody", 4401), ("observer", 4403), ("pilot", 4404)):
            own, path = Origin(here), "/ws/drones/alpha/control"
            with open_socket(f"ws{here[4:]}{path}", origin=own, ssl=visitor(certificates, name)) as opened:
                with pytest.raises(ConnectionClosed):
                    opened.recv(5)
                assert opened.close_code == code
        with pytest.raises(InvalidStatus):
            open_socket(
                f"ws{here[4:]}/ws/overview", origin=Origin(f"http{here[5:]}"), ssl=visitor(certificates, "pilot")
            )


def test_tokens_over_tls(certificates: Path, tokens: Path) -> None:
    access = Access(token_file=tokens, tls_cert=certificates / "server.pem", tls_key=certificates / "server.key")
    with served(access=access) as address:
        body = json.dumps({"token": PILOT}).encode()
        headers = {"Content-Type": "application/json", "Origin": address}
        request = urllib.request.Request(f"{address}/api/login", body, headers)
        with urllib.request.urlopen(request, timeout=5, context=visitor(certificates, None)) as answer:
            assert "Secure" in answer.headers["Set-Cookie"]


def test_https_with_a_generated_certificate(
    tmp_path: Path, tokens: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    access = with_certificate(Access(token_file=tokens), tmp_path / "keys" / "pages")
    assert access.page_authority is not None
    trusting = ssl.create_default_context(cafile=str(access.page_authority))
    with served(access=access) as address:
        assert address.startswith("https://")
        assert ask(address, "/api/session", tls=trusting)["role"] is None
        with urllib.request.urlopen(f"{address}/api/authority", timeout=5, context=trusting) as answer:
            assert answer.read() == access.page_authority.read_bytes()
            assert "attachment" in answer.headers["content-disposition"]
        with pytest.raises(OSError, match="certificate"):
            ask(address, "/api/session", tls=ssl.create_default_context())
    monkeypatch.setattr("skyloop.cockpit.server.own_addresses", lambda: ["8.8.8.8"])
    with_certificate(Access("0.0.0.0", token_file=tokens), tmp_path / "keys" / "pages")
    assert "8.8.8.8" in capsys.readouterr().err
    with pytest.raises(UsageError, match="give one of them"):
        with_certificate(access, tmp_path / "keys" / "pages")


def test_where_no_one_tells_whose_program_connects_the_browser_is_paired(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As on macOS and Windows; the program that started the cockpit has a token to observe."""
    monkeypatch.setattr("skyloop.cockpit.server.sees_peers", lambda: False)
    token = "of-the-program-that-started-it"
    with served(access=Access(observer_token=token), recordings=tmp_path) as address:
        page, _, code = address.partition("/#pair=")
        assert ask(page, "/api/statistics", token)["frames_sent"] == 0
        for wrong in (None, "x" * 24, code):
            with pytest.raises(urllib.error.HTTPError, match="401"):
                ask(page, "/api/statistics", wrong)
        headers = {"content-type": "application/json", "origin": page}
        login = urllib.request.Request(f"{page}/api/login", json.dumps({"token": code}).encode(), headers)
        with urllib.request.urlopen(login) as answer:
            assert json.load(answer)["role"] == "pilot"
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(login)


# As a separate process ----------------------------------------------------------------------------------------------


@pytest.mark.daily
@pytest.mark.process
def test_page_of_a_real_drone(tmp_path: Path) -> None:
    with connect("sim://?cameras=front&width=64&fps=10") as drone, CockpitProcess(drone.name) as page:
        own, headers = log_in(page.address())
        streams = f"{own.replace('http', 'ws')}/ws/drones/{drone.name}"
        with open_socket(f"{streams}/telemetry", origin=Origin(own), additional_headers=headers) as telemetry:
            vehicle, state = (json.loads(telemetry.recv(5)) for _ in range(2))
            assert vehicle["cameras"] == [{"name": "front", "width": 64, "height": 48}]
            assert state["feedback"]["state"] == "landed"
            assert state["link"]["application"] == "up"
            assert state["truth"]["position"]
        with open_socket(f"{streams}/video/front", origin=Origin(own), additional_headers=headers) as video:
            frame = video.recv(5)
            assert isinstance(frame, bytes)
            assert frame[-2:] == b"\xff\xd9", "a whole JPEG file"
            with pytest.raises(TimeoutError):
                video.recv(0.3)  # three more were captured: none is sent before the first is acknowledged
            video.send(json.dumps({"ack": 1}))
            assert isinstance(video.recv(5), bytes)
        for foreign in (Origin("http://evil.example"), None):
            for path in ("telemetry", "control"):
                with pytest.raises(InvalidStatus) as refused:
                    open_socket(f"{streams}/{path}", origin=foreign, additional_headers=headers)
                assert refused.value.response.status_code == 403
        assert page.statistics()["frames_sent"] == 2
        assert drone.authority.state == "held", "who watches takes nothing away"
        with Pages(own, drone.name, count=3, token=page._token if headers else None) as pages:
            for client in pages.clients:
                while client.frames < 3:
                    drone.next_frame()
            assert pages.problem is None
            assert pages.newest_age_s is not None
        assert page.statistics()["frames_encoded"] <= drone.stats["video/front"].count + 5
        with open_socket(f"{streams}/control", origin=Origin(own), additional_headers=headers) as control:
            control.send(f'{{"do":"take","priority":2,"at_s":{time.monotonic()}}}')
            told: dict[str, Any] = {}
            while told != {"type": "done", "do": "take"}:
                told = json.loads(control.recv(5))
            control.send(f'{{"do":"takeoff","at_s":{time.monotonic()}}}')
            drone.wait("taking_off", 5)
        drone.wait(lambda feedback: feedback.owner_id == drone.app_id, 5)
        assert drone.feedback().state is not FlightState.LANDED, "left as it was, for who is next"
        assert not (tmp_path / "recordings").exists()


@pytest.mark.process
def test_the_process_keeps_its_priority(tmp_path: Path) -> None:
    """A person's sticks pass through it."""
    with CockpitProcess(recordings=tmp_path / "here") as page:
        page.address()
        pid = page.pid
        assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0)
        assert ask(page.address().rstrip("/"), "/api/recordings")["folder"] == str(tmp_path / "here")
    assert not Path(f"/proc/{pid}").exists()


@only_on("linux", reason="threads have no niceness of their own there")
def test_encoding_threads_have_a_lower_priority() -> None:
    usual = os.getpriority(os.PRIO_PROCESS, 0)
    assert _ENCODER.submit(os.getpriority, os.PRIO_PROCESS, 0).result(5) == usual + NICENESS
    assert os.getpriority(os.PRIO_PROCESS, 0) == usual
