"""The processors that the workers of ``test_processors.py`` run."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from skyloop.client import Frame


class Marks:
    """Reports which process handled the frame."""

    def process(self, frame: Frame) -> dict[str, int]:
        return {"pid": os.getpid(), "mean": int(frame.mean())}


class Others(Marks):
    """The same processor under another name, so its code counts as different."""
