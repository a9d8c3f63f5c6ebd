"""Make the command-line reference from the commands: the site's pages, in reStructuredText.

python scripts/command_reference.py    # prints it; `make docs` puts it into the site
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

from typer.main import get_command

from skyloop.cli.app import build, described
from skyloop.cli.commands import COMMANDS, Task

_HELP: Final = ("--help", "-h, --help")  # every command has it
_OPTION: Final = re.compile(r"(?<![\w-])(--?[a-zA-Z][\w-]*)")
_MARKUP: Final = re.compile(r"([\\*`|_<>])")


def pages() -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each command's page, grouped by task."""
    group = get_command(build())
    root = _context(group, "skyloop", None)
    for name in COMMANDS:
        text = "\n".join(_command(group.commands[name], name, root, "="))  # type: ignore[attr-defined]
        yield f"skyloop-{name}", text + "\n"


def overview(folder: str) -> str:
    """Return the commands grouped by task, with links to their pages.

    Args:
        folder: The folder of those pages, relative to the listing page.
    """
    lines: list[str] = []
    for task in Task:
        mine = {name: entry for name, entry in COMMANDS.items() if entry.task is task}
        lines += _title(task.value, "-")
        lines += [
            f"- :doc:`skyloop {name} <{folder}/skyloop-{name}>`: {_prose(entry.summary)}"
            for name, entry in mine.items()
        ]
        lines += ["", ".. toctree::", "   :hidden:", "", *(f"   {folder}/skyloop-{name}" for name in mine), ""]
    return "\n".join(lines)


def reference() -> str:
    """Return the pages of all commands in sequence."""
    return "\n".join(text for _, text in pages())


def _command(command: Any, name: str, parent: Any, underline: str) -> Iterator[str]:
    context = _context(command, name, parent)
    yield from _title(context.command_path, underline)
    yield from (f".. program:: {context.command_path}", "")
    usage = " ".join(filter(None, command.collect_usage_pieces(context)))
    yield from (".. code-block:: text", "", f"   {context.command_path} {usage}", "")
    for paragraph in (command.help or "").split("\n\n"):
        if " COMMAND --help shows more" not in paragraph:
            yield from (_prose(paragraph), "")
    if command.epilog:
        yield from ("Example:", "", ".. code-block:: text", "", f"   {command.epilog.removeprefix('Example: ')}", "")
    for rows in described(command, context).values():
        for words, meaning in rows:
            if words not in _HELP:
                yield from (f".. option:: {words}", "", f"   {_prose(meaning)}", "")
    for sub, inner in getattr(command, "commands", {}).items():
        yield from _command(inner, sub, context, "-")
    for word, other in getattr(command, "behaviours", {}).items():
        yield from _command(other, f"{name} {word}", parent, "-")


def _context(command: Any, name: str, parent: Any) -> Any:
    return command.context_class(command, info_name=name, parent=parent)


def _title(words: str, underline: str) -> tuple[str, ...]:
    return (words, underline * len(words), "")


def _prose(text: str) -> str:
    """Return help as reStructuredText: options as code, and no other markup."""
    parts = _OPTION.split(" ".join(text.split()))
    return "".join(f"``{part}``" if number % 2 else _MARKUP.sub(r"\\\1", part) for number, part in enumerate(parts))


if __name__ == "__main__":
    print(reference())
