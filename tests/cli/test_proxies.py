"""The commands that start, list and watch proxies, with real ones."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.sim import address
from skyloop.cli.text import columns
from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from tests.support.commands import FAST_SIM, Run
from tests.support.processes import Process, eventually, in_terminal

pytestmark = pytest.mark.process


@contextmanager
def stopped(process: Process) -> Iterator[None]:
    """Suspend it, like Ctrl-Z."""
    process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.signal(signal.SIGCONT)


def answers() -> bool:
    with skyloop.connect("alpha", access="observe", timeout_s=1.0) as drone:
        return drone.feedback().vehicle_link == "up"


# list ----------------------------------------------------------------------------------------------------------


def test_the_list_shows_what_runs_and_who_flies(run: Run, alpha: Process) -> None:
    with skyloop.connect("alpha", name="the pilot"):
        shown = run("list").out.splitlines()
        assert shown[0].split() == ["NAME", "HOST", "BY", "STATE", "BATTERY", "PILOT", "LINK", "ADDRESS"]
        assert shown[1].split()[:4] == ["alpha", platform.node(), "local", "landed"]
        assert "the pilot" in shown[1]
        (row,) = json.loads(run("list", "--json").out)
        assert (row["name"], row["pid"], row["uri"], row["owner"], row["vehicle_link"], row["problem"]) == (
            ("alpha", alpha.pid, FAST_SIM, "the pilot", "up", "")
        )


def test_the_list_of_none_says_how_to_start_one(
    run: Run, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"/tmp/skyloop-none-{os.getpid()}")
    assert run("list") == (
        0,
        "No proxy is running on this host. Start one: skyloop proxy sim:// --name alpha\n",
        "",
    )
    assert run("list", "--json").out == "[]\n"


def test_every_command_reports_a_stopped_proxy(
    run: Run, alpha: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module("skyloop.client.connect"), "NAME_TIMEOUT_S", 0.1)
    (tmp_path / "mine.py").write_text("import skyloop\nclass Mine(skyloop.Controller): pass\n")
    silent = f"the proxy at local:alpha (pid {alpha.pid}) was reached but did not answer"
    with stopped(alpha):
        assert silent in run("list").out
        for words in (["param", "alpha"], ["watch", "alpha"], ["fly", str(tmp_path / "mine.py"), "--drone", "alpha"]):
            ended = run(*words)
            assert ended.code == 1
            assert silent in ended.err
            assert len(ended.err.splitlines()) == 1
        examined = run("doctor")
        assert examined.code == 1
        assert f"kill -CONT {alpha.pid}" in examined.out
        taken = run("proxy", "sim://", "--name", "alpha")
        assert taken.code == 2
        assert f"the name 'alpha' is in use by a running proxy (pid {alpha.pid})" in taken.err
    eventually(answers, "it goes on")


def test_columns_stand_below_one_another() -> None:
    assert columns([("a", "bb", ""), ("ccc", "d", "e")]) == ["a    bb", "ccc  d   e"]


# watch ---------------------------------------------------------------------------------------------------------


def test_watching_into_a_pipe_is_a_line_a_second(run: Run, alpha: Process) -> None:
    ended = run("watch", "alpha", "--seconds", "1")
    assert ended.code == 0
    states = [line for line in ended.out.splitlines() if "battery" in line]
    assert len(states) == 2
    assert all("landed" in line and "pilot nobody" in line and "vehicle up" in line for line in states)
    assert "feedback" in states[1]
    assert "\x1b" not in ended.out


def test_watching_for_programs_is_an_object_a_line(run: Run, alpha: Process) -> None:
    first = json.loads(run("watch", "alpha", "--json", "--seconds", "0").out.splitlines()[0])
    assert first["feedback"]["state"] == "landed"
    assert first["link"]["application"] == "up"
    assert "command" in first["stats"]


def test_watching_shows_events_as_they_arrive(start: Callable[..., Process], alpha: Process) -> None:
    process = start("watch", "alpha")
    process.until("pilot nobody")
    with skyloop.connect("alpha", name="the pilot"):
        process.until("the pilot")
    process.signal(signal.SIGINT)
    assert process.wait() == 0
    assert "Traceback" not in process.text


def test_watching_in_a_terminal_shows_a_live_screen(alpha: Process) -> None:
    text = in_terminal("watch", "alpha", "--seconds", "0.5", columns=80)
    for words in ("alpha", "roll, pitch, yaw", "link to vehicle", "delay median", "feedback"):
        assert words in text


@pytest.mark.parametrize("width", [48, 80])
def test_watching_in_a_narrow_terminal_breaks_no_words_or_figures(alpha: Process, width: int) -> None:
    text = in_terminal("watch", "alpha", "--seconds", "0.5", columns=width)
    lines = [line for line in text.splitlines() if "velocity" in line]
    assert lines
    assert all("m/s" in line for line in lines)
    for words in ("feedback", "link to vehicle", "roll, pitch, yaw"):
        assert words in text


def test_a_reader_that_closes_the_pipe_is_not_an_error(alpha: Process) -> None:
    watching = f"{sys.executable} -m skyloop watch alpha --seconds 3 | head -n 1"
    done = subprocess.run(["sh", "-c", watching], capture_output=True, text=True, timeout=20, check=True)
    assert "landed" in done.stdout
    assert done.stderr == ""


# proxy ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simm://"], "no vehicle driver named 'simm'; did you mean 'sim'?"),
        (["sim"], "'sim' is not a vehicle's address, such as sim://"),
        (["sim://?wurld=room"], "no option of sim:// named 'wurld'; did you mean 'world'?"),
        (["sim://?seed=x"], "option seed is 'x' and must be a number"),
        (["sim://?cameras=none", "--name", "Bad Name"], "'Bad Name' cannot be the name of a proxy"),
        (["sim://?cameras=none", "--group", "no-such-group"], "no group named 'no-such-group'"),
        (["sim://?world=rom&cameras=none", "--name", "free"], "no world named 'rom'; did you mean 'room'?"),
    ],
)
def test_a_proxy_that_cannot_start_says_why_in_one_line(
    run: Run, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.setattr("skyloop.cli.network.settle", lambda options: None)
    ended = run("proxy", *words)
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_process_that_simulates_makes_room_for_commands(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[object] = []
    monkeypatch.setattr("skyloop.cli.network.settle", lambda options: done.append(options.world))
    monkeypatch.setattr("skyloop.proxy.serve.serve", lambda *given, **options: done.append(given))
    monkeypatch.setattr("skyloop.proxy.serve.run", lambda proxies, **_: done.append([proxy.name for proxy in proxies]))
    run("proxy", "sim://?world=gates", "--name", "beta")
    run("proxy", "video://x.mp4")
    run("sim", "--world", "windy", "--option", "cameras=none", "--name", "gamma")
    world, video = parse_uri("sim://?world=gates"), parse_uri("video://x.mp4")
    assert done == ["gates", (world, "beta"), (video, "alpha"), "windy", ["gamma"]]


@pytest.mark.parametrize(("cameras", "cores"), [("front", "1"), ("none", "OpenCV is not imported")])
def test_it_yields_the_interpreter_lock_and_limits_opencvs_threads(cameras: str, cores: str) -> None:
    code = (
        "import sys; from skyloop.cli.network import settle; from skyloop.vehicles.sim.options import options_of;"
        "from skyloop.drivers.uri import parse_uri;"
        f"settle(options_of(parse_uri('sim://?cameras={cameras}')));"
        "print(sys.getswitchinterval());"
        "print(sys.modules['cv2'].getNumThreads() if 'cv2' in sys.modules else 'OpenCV is not imported')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["0.001", cores]


# sim -----------------------------------------------------------------------------------------------------------


def test_several_drones_of_one_world_end_together(start: Callable[..., Process], run: Run, sockets: Path) -> None:
    process = start("sim", "--drones", "3", "--world", "room", "--option", "cameras=none", "--name", "swarm")
    process.until("ready swarm3")
    names = ["swarm1", "swarm2", "swarm3"]
    places = []
    for name in names:
        with skyloop.connect(name, access="observe") as drone:
            native = drone.feedback().native or {}
            places.append((native["truth.x"], native["truth.y"]))
    assert len(set(places)) == 3, "each stands in a place of its own in the world that they share"
    taken = run("sim", "--drones", "2", "--option", "cameras=none", "--name", "swarm")
    assert taken.code == 2
    assert f"the name 'swarm1' is in use by a running proxy (pid {process.pid})" in taken.err
    process.signal(signal.SIGINT)
    assert process.wait() == 0
    assert not [path.name for path in sockets.glob("swarm*")]
    assert "Traceback" not in process.text


def test_a_name_that_is_taken_ends_the_others_too(run: Run, start: Callable[..., Process], sockets: Path) -> None:
    other = start("proxy", FAST_SIM, "--name", "pair2")
    other.until("ready")
    ended = run("sim", "--drones", "2", "--option", "cameras=none", "--name", "pair")
    assert ended.code == 2
    assert "the name 'pair2' is in use" in ended.err
    assert sorted(path.name for path in sockets.glob("pair*")) == ["pair2.sock"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--world", "rom"], "no world named 'rom'; did you mean 'room'?"),
        (["--world", "a&b"], "no world named 'a&b'; known: "),
        (["--world", "./none.toml"], "none.toml"),
        (["--drones", "100"], "has room for "),
        (["--option", "wurld=x"], "no option of sim:// named 'wurld'; did you mean 'world'?"),
        (["--name", "Bad"], "'Bad' cannot be the name of a proxy"),
    ],
)
def test_a_simulation_that_cannot_start_says_why_in_one_line(run: Run, words: list[str], said: str) -> None:
    ended = run("sim", "--option", "cameras=none", *words)
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1


def test_the_address_of_a_simulation_is_put_together_from_its_options() -> None:
    assert address("room", 3, 1.0, ["cameras=front,bottom", "wind=0"]) == (
        "sim://?world=room&seed=3&speed=1&cameras=front,bottom&wind=0"
    )


@pytest.mark.parametrize(
    ("others", "said"),
    [(["cameras"], "has no value"), (["seed=3"], "give --seed 3"), (["wind=0", "wind=1"], "given twice")],
)
def test_an_unknown_option_is_answered_with_the_known_ones(others: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        address("room", 0, 1.0, others)


# cockpit -------------------------------------------------------------------------------------------------------


def test_the_cockpit_says_what_is_wrong(run: Run, alpha: Process) -> None:
    import socket

    assert "did you mean 'alpha'?" in run("cockpit", "alfa").err
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        ended = run("cockpit", "alpha", "--port", str(port))
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith(f"skyloop: port {port} of 127.0.0.1 is in use by process {os.getpid()} (")
    assert ended.err.endswith("); port 0 takes a free one\n")


def test_the_list_names_the_drones_of_other_users(run: Run, alpha: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.transport.local.names_of_others", lambda: {"mary": ["bravo", "alpha"]})
    theirs = "mary runs alpha, bravo: a user's proxies are closed to others, except to a group (SKYLOOP_GROUP)."
    assert run("list").err == f"{theirs}\n"
    assert run("list", "--json").err == ""
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"/tmp/skyloop-none-{os.getpid()}")
    start = "Start one: skyloop proxy sim:// --name alpha"
    assert run("list").out == f"No proxy of yours is running on this host. {theirs} {start}\n"
    ours = "No proxy of yours is running on this host."
    assert run("land", "--all").err == f"skyloop: no drone found. {ours} {theirs} {start}\n"
