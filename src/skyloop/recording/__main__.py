"""``python -m skyloop.recording ORDER``: a recorder in its own process; see :mod:`skyloop.recording.child`."""

from __future__ import annotations

import sys

import msgspec

from skyloop.recording.child import Order, run_child

if __name__ == "__main__":
    sys.exit(run_child(msgspec.json.decode(sys.argv[1], type=Order)))
