"""``scripts/prose.py``: the phrases it finds, where it looks, and the ceilings it holds."""

from __future__ import annotations

from pathlib import Path

import prose
import pytest

STIFF = "Who comes later waits in vain. The one who was told goes on by itself for so long.\n"
PLAIN = "Late subscribers request a key frame. Return the newest sample, or None after `timeout_s`.\n"


def test_stiff_phrases_are_found_and_plain_ones_are_not(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text(STIFF + PLAIN)
    words, found = prose.search(path)
    assert words == len((STIFF + PLAIN.replace("`timeout_s`", " ")).split())
    assert {each.pattern for each in found} == {
        "clause for a noun",
        "archaic",
        "telling",
        "still standing",
        "by itself",
        "so much",
    }
    assert {each.line for each in found} == {1}


def test_docstrings_comments_and_messages_are_read_but_code_is_not(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(
        'anew = 1\n\n\ndef f() -> None:\n    """Begin it anew.\n\n    Or twice, till it ends.\n    """\n'
        '    raise ValueError(f"it was read {anew} times, then begun anew")  # in vain\n'
    )
    (tmp_path / "page.md").write_text("Use `anew`, see [it](anew.md).\n\n```\nanew\n```\n")
    assert [(each.path.name, each.line) for each in prose.search(tmp_path)[1]] == [
        ("module.py", 5),
        ("module.py", 7),
        ("module.py", 9),
        ("module.py", 9),
    ]


def test_a_ceiling_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "page.md").write_text(STIFF)
    (tmp_path / "budgets.toml").write_text('[prose]\n"page.md" = 0.5\n')
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    monkeypatch.setattr(prose, "BUDGETS", tmp_path / "budgets.toml")
    assert prose.main([]) == 0
    assert prose.main(["--check"]) == 1
    assert "page.md: " in capsys.readouterr().err
    (tmp_path / "page.md").write_text(PLAIN)
    assert prose.main(["--check"]) == 0
