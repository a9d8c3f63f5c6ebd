"""The findings of a check-up, as lines for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rich.text import Text


class Health(StrEnum):
    GOOD = "good"
    MISSING = "missing"  #: works without it
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report, and one of advice where there is any."""

    what: str
    health: Health
    detail: str
    advice: str = ""


MARKS: Final = {Health.GOOD: ("✓", "green"), Health.MISSING: ("–", "yellow"), Health.BAD: ("✗", "red")}


def as_text(finding: Finding) -> Text:
    """Return a finding as text for people."""
    mark, colour = MARKS[finding.health]
    text = Text.assemble((mark, colour), f" {finding.what}: {finding.detail}")
    return text.append(f"\n  → {finding.advice}", "bold") if finding.advice else text
