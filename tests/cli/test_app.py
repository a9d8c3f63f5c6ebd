"""The command line as a whole: help, wrong words, exit codes, and the cost of starting."""

from __future__ import annotations

import subprocess
import sys

import pytest
from typer.testing import CliRunner

import skyloop
from skyloop.cli import app as cli
from skyloop.cli.commands import COMMANDS, Task
from skyloop.errors import LinkError, ParameterError, UnknownNameError
from tests.support.commands import Run

runner = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"})


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example_in_80_columns(command: str) -> None:
    result = runner.invoke(cli.build([command]), [command, "--help"], prog_name="skyloop")
    assert result.exit_code == 0
    assert f"Example: skyloop {command}" in result.output
    assert max(map(len, result.output.splitlines())) <= 80


@pytest.mark.parametrize("columns", [40, 60, 80])
def test_help_fits_the_terminal_and_shows_no_types(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    for words in ([], *([command] for command in COMMANDS)):
        result = runner.invoke(cli.build(), [*words, "--help"], prog_name="skyloop", env={"COLUMNS": str(columns)})
        assert [line for line in result.output.splitlines() if len(line) > columns or "<" in line] == [], words


def test_the_list_of_commands_describes_each_by_task() -> None:
    result = runner.invoke(cli.build(), ["--help"], prog_name="skyloop")
    assert result.exit_code == 0
    titles = [line.removesuffix(":") for line in result.output.splitlines() if line[:1] != " " and line.endswith(":")]
    assert titles == ["Options", *Task]
    for command, entry in COMMANDS.items():
        assert any(line.split() == [command, *entry.summary.split()] for line in result.output.splitlines()), (
            f"{command} is cut off, or not there"
        )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_example_uses_only_known_words(command: str) -> None:
    """Parse the words without calling the command."""
    import typer

    group = typer.main.get_command(cli.build([command]))
    _, *words = COMMANDS[command].example.split()
    own = group.get_command(None, command)  # type: ignore[attr-defined]
    own.make_context(command, words)


def test_the_version_is_printed(run: Run) -> None:
    assert run("--version") == (0, f"skyloop {skyloop.__version__}\n", "")


def test_without_arguments_help_is_shown(run: Run) -> None:
    ended = run()
    assert ended == run("--help")
    assert (ended.code, ended.err) == (0, "")
    assert "\nFly:\n  demo " in ended.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["proxi"], "skyloop: no command proxi; did you mean 'proxy'"),
        (["list", "--jsn"], "skyloop list: no option --jsn; did you mean --json?"),
        (["proxy"], "skyloop proxy: URI is missing"),
        (["sim", "--drones", "0"], "skyloop sim: --drones: "),
        (["sim", "--drones", "many"], "skyloop sim: --drones: "),
        (["sim", "--drones"], "--drones needs a value"),
        (["sim", "--firmware", "foo"], "skyloop sim: --firmware: 'foo' is none of 'ardrone1'"),
        (["fly", "x.py", "--priority", "32"], "skyloop fly: --priority: "),
        (["cockpit", "alpha", "--port", "70000"], "skyloop cockpit: --port: "),
        (["watch", "a", "b"], "skyloop watch: too many words: b\nUsage: skyloop watch [OPTIONS] NAME\n"),
        (["log", "inf"], "skyloop log: no command inf; did you mean 'info'?"),
    ],
)
def test_an_unknown_word_exits_with_2_and_gets_a_suggestion(run: Run, words: list[str], said: str) -> None:
    ended = run(*words)
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    for word in ("Input", "Error", "Invalid", "pydantic", "Traceback", "(s)"):
        assert word not in ended.err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UnknownNameError("proxy", "alfa", ["alpha"]), 2),
        (ParameterError("limits.tilt must be less"), 2),
        (LinkError("gone"), 1),
    ],
)
def test_errors_are_one_line_and_an_exit_code(
    run: Run, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr("skyloop.cli.listing.list_proxies", fail)
    assert run("list") == (code, "", f"skyloop: {error}\n")


def test_ctrl_c_exits_with_the_status_that_shells_expect(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("skyloop.cli.listing.list_proxies", interrupted)
    assert run("list").code == 130


def test_ctrl_c_while_the_commands_are_imported_shows_no_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(names: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("skyloop.cli.app.build", interrupted)
    assert run("list") == (130, "", "")


def test_help_makes_no_command() -> None:
    code = (
        "import sys; from skyloop.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: print(*[m for m in sys.modules if m.startswith('skyloop.') and m.count('.') == 1])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.splitlines()[-1].split()) <= {"skyloop.cli", "skyloop.errors"}


def test_a_command_imports_nothing_that_it_does_not_need() -> None:
    """A private proxy, or a list, would only pay for it at its start."""
    code = (
        "import sys; from skyloop.cli.app import build; build(['proxy', 'list', 'fly', 'param', 'sim', 'cockpit']);"
        "print(*[m for m in ('cv2', 'av', 'rich.live', 'rich.table', 'uvicorn', 'skyloop.client', 'skyloop.proxy',"
        "'skyloop.sim', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
