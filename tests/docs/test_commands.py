"""The command lines on the pages exist, with their options; so do make's targets and the extras."""

from __future__ import annotations

import re
import shlex
import tomllib

import pytest
from typer.main import get_command

from skyloop.cli.app import build
from tests.support.pages import PAGES, ROOT, blocks, spans

SHELL = [
    line.strip()
    for block in blocks("", "bash", "sh", "console")
    for line in block.code.replace("\\\n", " ").splitlines()
]
SPANS = sorted({span for page in PAGES for span in spans(page)})
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
GROUP = get_command(build())


def words(line: str) -> list[str]:
    return shlex.split(line.removeprefix("$ "), comments=True)


def parse(name: str, arguments: list[str]) -> None:
    """Parse a command line; raise the error that the user would see."""
    command = GROUP.commands[name]  # type: ignore[attr-defined]
    command.make_context(name, list(arguments))


LINES = sorted({line for line in SHELL if words(line)[:1] == ["skyloop"]})


def test_the_pages_show_command_lines() -> None:
    assert len(LINES) >= 4


@pytest.mark.parametrize("line", LINES)
def test_a_command_line_is_accepted(line: str) -> None:
    if words(line)[1].startswith("--"):
        assert words(line)[1] in {word for param in GROUP.params for word in param.opts}
        return
    parse(words(line)[1], words(line)[2:])


@pytest.mark.parametrize("span", [span for span in SPANS if span.startswith("skyloop ")])
def test_a_command_in_the_text_is_accepted(span: str) -> None:
    _, name, *arguments = words(span)
    if name == "COMMAND" or name.startswith("-"):
        return
    assert name in GROUP.commands  # type: ignore[attr-defined]
    if arguments:
        parse(name, arguments)


@pytest.mark.parametrize("line", sorted({line for line in (*SHELL, *SPANS) if line.startswith("make ")}))
def test_a_target_of_make_exists(line: str) -> None:
    target = words(line)[1]
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    if target == "demo":
        for extra in (word for word in words(line)[2:] if word.startswith("ARGS=")):
            parse("demo", shlex.split(extra.removeprefix("ARGS=")))


_PLACEHOLDERS = {"NAME", "PART…"}
INSTALLS = sorted(
    {line for line in (*SHELL, *SPANS) if "skyloop install" in line and not _PLACEHOLDERS & {*line.split()}}
)


@pytest.mark.parametrize("line", INSTALLS)
def test_extras_to_install_exist(line: str) -> None:
    assert set(words(line)[2:]) <= {*EXTRAS, "all"}


def test_no_page_installs_extras_as_only_a_release_could() -> None:
    """Before there is a release, ``pip install 'skyloop[…]'`` finds nothing; ``skyloop install`` works with any."""
    assert len(INSTALLS) > 20
    for folder in ("docs", "examples", "scripts", "src"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in (".md", ".py", ".ipynb", ".rst", ".toml"):
                text = file.read_text(encoding="utf-8")
                assert not re.search(r"pip install[^`\n]*(?:skyloop\\*\[|-e '\.\[)", text), file
