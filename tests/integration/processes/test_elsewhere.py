"""What people do on Windows and macOS, in processes that believe to run there (``tests/support/elsewhere``).

The tests themselves run on Linux and reach those proxies over the portable side of the local transport.
"""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

import skyloop
from skyloop.messages import Failsafe, FlightState, LinkState
from skyloop.transport.local import list_names
from tests.support.processes import PILOTS, Process, eventually, skyloop_command, stopped
from tests.support.systems import only_root
from tests.support.tello_addresses import Addresses

pytestmark = [
    pytest.mark.process,
    pytest.mark.timeout(240),
    pytest.mark.skipif("SKYLOOP_PRETEND" in os.environ, reason="starts processes on other systems from Linux"),
]

ROOT = Path(__file__).parents[3]
SHARED = Path("/dev/shm")
EMPTY = "sim://?world=empty&cameras=none&wind=0"
SEES = "sim://?world=empty&cameras=front&wind=0"
GONE_S = 5.0  # within which nothing of a killed process is left
ONE_KEY_S = 0.05

WATCHES = """
import sys, skyloop
with skyloop.connect(sys.argv[1], access="observe") as drone:
    while True:
        print("saw", drone.next_frame(timeout_s=60.0).shape, flush=True)
"""
SPINS = """
import skyloop
class Spin(skyloop.Controller):
    def on_frame(self, frame):
        self.drone.velocity(yaw_rate={rate})
"""
AS_ANOTHER_USER = """
import os, socket, sys

os.setgroups([])
os.setgid(65534)
os.setuid(65534)
page, port, *files = sys.argv[1:]
for file in files:
    try:
        print("READ", open(file, "rb").read(8))
    except PermissionError:
        print("refused")

def ask(port, question):
    with socket.socket() as sock:
        sock.connect(("127.0.0.1", int(port)))
        sock.sendall(question(sock))
        try:
            answer = sock.recv(4096)
            while answer.startswith(b"HTTP/1.1 101 ") and answer.endswith(b"\\r\\n\\r\\n"):
                answer += sock.recv(4096)
            return answer
        except ConnectionResetError:
            return b""

print("refused" if not ask(port, lambda sock: sock.recv(100) * 4) else "LET IN")
for path in ("api/drones", "api/recordings", "ws/drones/alpha/control"):
    web = "Connection: Upgrade\\r\\nUpgrade: websocket\\r\\nSec-WebSocket-Version: 13\\r\\nSec-WebSocket-Key: "
    web = web + "A" * 22 + "==\\r\\n" if path.startswith("ws") else ""
    lines = f"GET /{path} HTTP/1.1\\r\\nHost: 127.0.0.1:{page}\\r\\nOrigin: http://127.0.0.1:{page}\\r\\n{web}\\r\\n"
    answer = ask(page, lambda _: lines.encode())
    closed = answer.startswith(b"HTTP/1.1 101 ") and answer.partition(b"\\r\\n\\r\\n")[2][:1] == b"\\x88"
    print("refused" if closed or answer.split()[1] in (b"401", b"403") else answer)
"""


@pytest.fixture(params=["win32", "darwin"], autouse=True)
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The system where processes of this test believe to run."""
    paths = [str(ROOT / "tests/support/elsewhere"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv("SKYLOOP_PRETEND", request.param)
    return str(request.param)


def processes(runtime_dir: Path) -> dict[int, str]:
    """Return the processes that use this directory of proxies, except this one."""
    found = {}
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and int(folder.name) != os.getpid():
                ended = (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
                if not ended and b"=" + bytes(runtime_dir) + b"\0" in (folder / "environ").read_bytes():
                    found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            continue
    return found


def mapped(name: str) -> bool:
    """Return whether a process maps this shared memory."""
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            if name in maps.read_text():
                return True
        except OSError:
            continue
    return False


def memory(system: str, prefix: str) -> bool:
    """Return whether there is shared memory whose names begin like this. On Windows, it exists while it is mapped."""
    if system == "win32":
        return mapped(f"as-on-windows-{prefix}-")
    return any(SHARED.glob(f"{prefix}-*"))


def registration(path: Path) -> tuple[int, str]:
    """Return a proxy's port, and the prefix of the names of its memory (docs/wire-format.md)."""
    content = path.read_bytes()
    return int.from_bytes(content[10:12], "little"), content[48:].rstrip(b"\0").decode()


def proxy_at(start: Callable[..., Process], uri: str = EMPTY) -> Process:
    process = start("-m", "skyloop", "proxy", uri, "--name", "alpha")
    process.until("ready", 60)
    return process


def flown_by(start: Callable[..., Process], observer: skyloop.Drone) -> Process:
    """Start a pilot, and wait until the drone flies."""
    pilot = start(PILOTS, "fly", "alpha")
    pilot.until("flying", 60)
    observer.wait("flying", timeout_s=30.0)
    return pilot


# Flights -----------------------------------------------------------------------------------------------------------


@pytest.mark.daily
def test_the_first_controller_of_the_readme(start: Callable[..., Process], tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    code = next(block for block in blocks if "class Follow" in block)
    (tmp_path / "follow.py").write_text(code.replace("seconds=30", "seconds=4"))
    program = start(str(tmp_path / "follow.py"))
    assert program.wait(120) == 0
    program.until("frames")


def test_flying_without_a_second_process(start: Callable[..., Process], sockets: Path) -> None:
    if not any(
        entry.value.startswith("skyloop.stepping.in_process") for entry in entry_points(group="skyloop.connectors")
    ):
        pytest.skip("this installation of skyloop is older than sim://?process=none")
    program = start(
        "-c",
        f"import skyloop\nwith skyloop.connect('{SEES}&process=none') as drone:\n    drone.takeoff()\n"
        "    print('saw', drone.next_frame(timeout_s=60.0).shape, flush=True)\n    input()",
    )
    program.until("saw (240, 320, 3)", 120)
    assert list(processes(sockets)) == [program.pid]
    assert not list_names()


def test_three_drones(start: Callable[..., Process]) -> None:
    start("-m", "skyloop", "sim", "--drones", "3", "--world", "empty").until("ready sim3", 60)
    listing = skyloop_command("list")
    assert all(name in listing for name in ("sim1", "sim2", "sim3")), listing
    swarm = start(
        "-c",
        "import skyloop\nwith skyloop.swarm('sim*') as drones:\n    drones.takeoff()\n"
        "    for name in drones.feedback():\n"
        "        print(name, drones[name].next_frame(timeout_s=60.0).shape, flush=True)\n    drones.land()\n",
    )
    assert swarm.wait(120) == 0
    swarm.until("sim3 (")


def test_the_page_flies_and_a_file_is_reloaded(start: Callable[..., Process], tmp_path: Path) -> None:
    from websockets.sync.client import connect
    from websockets.typing import Origin

    start("-m", "skyloop", "sim", "--name", "alpha", "--world", "empty").until("ready", 60)
    page = start("-m", "skyloop", "cockpit", "--port", "0", "--recordings", str(tmp_path))
    page.until("#pair=", 60)
    page.until("\n", 5)
    found = re.search(r"(http://127.0.0.1:\d+)/#pair=(\S{20,})", page.text)
    assert found is not None, page.text
    address, code = found.groups()
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(f"{address}/api/drones")
    headers = {"content-type": "application/json", "origin": address}
    request = urllib.request.Request(f"{address}/api/login", json.dumps({"token": code}).encode(), headers)
    with urllib.request.urlopen(request) as answer:
        cookie = answer.headers["set-cookie"].partition(";")[0]
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(request)
    with (
        skyloop.connect("alpha", access="observe") as observer,
        connect(
            f"{address.replace('http', 'ws')}/ws/drones/alpha/control",
            origin=Origin(address),
            additional_headers={"cookie": cookie},
        ) as socket,
    ):

        def say(do: str, **values: Any) -> None:
            now_s = time.monotonic()
            socket.send(json.dumps({"do": do, "at_s": now_s, **values} | ({"seen_s": now_s} if do == "ping" else {})))

        def flies(state: str) -> bool:
            say("ping")
            time.sleep(ONE_KEY_S)
            return observer.feedback().state == state

        say("take", priority=4)
        eventually(lambda: flies("landed") and observer.feedback().owner is not None, "the page has the authority")
        say("takeoff")
        eventually(lambda: flies("hovering"), "it has taken off")
        say("land")
        eventually(lambda: flies("landed"), "it has landed")
        say("release")
        eventually(lambda: flies("landed") and observer.feedback().owner is None, "the page gave the authority back")

        file = tmp_path / "spin.py"
        file.write_text(SPINS.format(rate=0.5))
        pilot = start("-m", "skyloop", "fly", str(file), "--drone", "alpha", "--reload")
        rates: list[float] = []
        observer.on_command(lambda echo: rates.append(getattr(echo.applied, "yaw_rate", 0.0)))
        eventually(lambda: 0.5 in rates, "it turns", 60.0)
        file.write_text(SPINS.format(rate=-1.0))
        eventually(lambda: -1.0 in rates, "it turns the other way")
        pilot.signal(signal.SIGINT)
        observer.wait("landed", timeout_s=30.0)
        pilot.wait()


def test_a_recording_is_replayed(start: Callable[..., Process], tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    proxy_at(start, SEES)
    start("-c", WATCHES, "alpha").until("saw", 90)  # drawing may begin slowly
    flight = tmp_path / "flight.mcap"
    recorder = start("-m", "skyloop", "record", "alpha", "-o", str(flight), "--seconds", "6")
    assert recorder.wait(120) == 0, recorder.text
    for how in ("wait=1", "speed=max"):
        replay = start(
            "-c",
            f"import skyloop\nwith skyloop.connect('replay://{flight}?{how}', on_exit='hover') as drone:"
            "\n    seen = []\n    drone.on_frame(lambda frame: seen.append(frame.seq))\n"
            "    drone.wait(lambda feedback: len(seen) > 30, timeout_s=30.0)\n    print('saw them', flush=True)\n",
        )
        replay.until("saw them", 60)
        assert replay.wait() == 0, replay.text


def test_an_emulated_tello(start: Callable[..., Process]) -> None:
    pytest.importorskip("av")
    addresses = Addresses.free()
    start("-m", "skyloop", "sim", "--firmware", "tello", "--bind", addresses.drone).until("commands udp", 60)
    program = start(
        "-c",
        f"import skyloop\nwith skyloop.connect('{addresses.uri()}') as drone:\n    drone.takeoff()\n"
        "    print('saw', drone.next_frame(timeout_s=30.0).shape, flush=True)\n    drone.land()\n"
        "    print(drone.feedback().state, flush=True)",
    )
    program.until("saw (720, 960, 3)", 90)
    assert program.wait() == 0, program.text


def test_keys_in_the_console(start: Callable[..., Process]) -> None:
    proxy_at(start)
    up = b"\x1b[A"
    person, console = os.openpty()
    with (
        skyloop.connect("alpha", access="observe") as observer,
        subprocess.Popen(
            [sys.executable, "-m", "skyloop", "teleop", "alpha"], stdin=console, stdout=console, stderr=console
        ) as teleop,
    ):
        os.close(console)

        def shown() -> None:
            """Take what it draws, so that its terminal is never full."""
            while select.select([person], [], [], 0)[0] and os.read(person, 65536):
                pass

        def press(key: bytes, wanted: Callable[[Any], bool]) -> None:
            def held() -> bool:
                os.write(person, key)
                time.sleep(ONE_KEY_S)
                shown()
                return wanted(observer.feedback())

            eventually(held, f"{key!r} has an effect", 40.0)

        try:
            press(b"t", lambda feedback: feedback.state == "hovering")
            press(b"w", lambda feedback: feedback.velocity_m_s[0] > 0.2)
            press(up, lambda feedback: feedback.velocity_m_s[2] > 0.2)
            press(b"l", lambda feedback: feedback.state == "landed")
            os.write(person, b"q")

            def ended() -> bool:
                shown()
                return teleop.poll() is not None

            eventually(ended, "it ends")
        except OSError:  # the other end is closed
            pass
        finally:
            if teleop.poll() is None:
                teleop.kill()
    assert teleop.returncode == 0
    os.close(person)


# Ends --------------------------------------------------------------------------------------------------------------


@pytest.mark.daily
def test_a_killed_pilot_leaves_a_drone_that_hovers_and_lands(start: Callable[..., Process]) -> None:
    proxy_at(start)
    with skyloop.connect("alpha", access="observe") as observer:
        pilot = flown_by(start, observer)
        pilot.signal(signal.SIGKILL)
        killed = time.monotonic()
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        assert time.monotonic() - killed < 2.5
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        assert 4.5 < time.monotonic() - killed < 8.0
        observer.wait("landed", timeout_s=30.0)


def test_a_stopped_pilot_leaves_a_drone_that_hovers_and_lands(start: Callable[..., Process]) -> None:
    proxy_at(start)
    with skyloop.connect("alpha", access="observe") as observer:
        pilot = flown_by(start, observer)
        with stopped(pilot.pid):
            begin = time.monotonic()
            observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
            assert time.monotonic() - begin < 3.0
            observer.wait("landed", timeout_s=30.0)


def test_a_stopped_proxy_is_lost_and_found(start: Callable[..., Process]) -> None:
    process = proxy_at(start)
    with skyloop.connect("alpha") as drone:
        with stopped(process.pid):
            eventually(lambda: drone.link.application is LinkState.LOST, "silence is a loss")
            assert drone.velocity(forward=0.3) is False
        eventually(lambda: drone.authority.state == "held", "the authority is back")


@pytest.mark.daily
@pytest.mark.parametrize("victims", ["proxy", "proxy and pilot", "program"])
def test_a_killed_process_leaves_no_memory_and_no_child(
    start: Callable[..., Process], system: str, sockets: Path, victims: str
) -> None:
    killed = []
    if victims != "program":
        killed += [proxy_at(start, SEES)]
    else:
        code = f"drone = skyloop.connect('{SEES}'); drone.next_frame(timeout_s=60.0); print('saw', flush=True)"
        killed += [start("-c", f"import skyloop, time; {code}; time.sleep(60)")]
        killed[0].until("saw", 90)
    (proxy,) = list_names()
    watcher = start("-c", WATCHES, proxy.name)
    watcher.until("saw", 90)
    if victims == "proxy and pilot":
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying", 60)
        killed += [pilot]
    _, prefix = registration(proxy.path)
    assert memory(system, prefix)
    for process in killed:
        process.signal(signal.SIGKILL)
    watcher.signal(signal.SIGKILL)  # last, because Windows keeps memory that someone maps
    for process in (watcher, *killed):
        process.wait()
    eventually(lambda: not memory(system, prefix), "no memory is left", GONE_S)
    eventually(lambda: not processes(sockets), "no process is left", GONE_S)
    assert not list_names()


@pytest.mark.parametrize("command", ["demo", "proxy", "fly", "host"])
def test_ctrl_c_lands(start: Callable[..., Process], sockets: Path, tmp_path: Path, command: str) -> None:
    (tmp_path / "spin.py").write_text(SPINS.format(rate=0.5))
    if command == "proxy":
        program = proxy_at(start)
    elif command == "host":
        fleet = tmp_path / "fleet.toml"
        fleet.write_text(f'[[vehicle]]\nname = "alpha"\naddress = "{EMPTY}"\nprocess = "own"\n')
        program = start("-m", "skyloop", "host", str(fleet))
    elif command == "fly":
        program = start("-m", "skyloop", "fly", str(tmp_path / "spin.py"))
    else:
        program = start("-m", "skyloop", "demo", "--headless", "--seconds", "120")
    eventually(lambda: bool(list_names()), "there is a proxy", 60.0)
    name = list_names()[0].name
    with skyloop.connect(name, access="observe") as observer:
        states: list[FlightState] = []
        observer.on_feedback(lambda feedback: states.append(feedback.state), inline=True)
        if command in ("proxy", "host"):
            flown_by(start, observer)
        observer.wait("flying", timeout_s=60.0)
        program.signal(signal.SIGINT)
        interrupted = time.monotonic()
        observer.wait(lambda feedback: feedback.state in ("landing", "landed"), timeout_s=30.0)
        assert time.monotonic() - interrupted < 3.0
        program.wait(60)
        assert states[-1] == "landed"
    eventually(lambda: all(PILOTS in line for line in processes(sockets).values()), "no process is left", GONE_S)


# Others ------------------------------------------------------------------------------------------------------------


@only_root("become another user")
def test_another_user_neither_connects_nor_sees_anything(
    start: Callable[..., Process], system: str, sockets: Path, tmp_path: Path
) -> None:
    proxy_at(start, SEES)
    start("-c", WATCHES, "alpha").until("saw", 90)
    page = start("-m", "skyloop", "cockpit", "--port", "0", "--recordings", str(tmp_path))
    page.until("#pair=", 60)
    page_port = page.text.partition("http://127.0.0.1:")[2].partition("/")[0]
    port, prefix = registration(sockets / "alpha.port")
    for folder in (sockets.parent, sockets):
        folder.chmod(0o755)  # even if they could enter
    memory = [*SHARED.glob(f"{prefix}-*")]  # the stand-in for Windows has none that another user could open by name
    files = [sockets / "alpha.port", *memory]
    assert bool(memory) == (system == "darwin")
    ended = subprocess.run(
        [sys.executable, "-I", "-c", AS_ANOTHER_USER, page_port, str(port), *map(str, files)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ended.stdout.split() == ["refused"] * (len(files) + 4), ended.stdout + ended.stderr
