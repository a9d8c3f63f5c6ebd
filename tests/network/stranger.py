"""A stranger with nothing but Zenoh."""

from __future__ import annotations

import json
from typing import Any

import zenoh


def stranger(**sections: list[str]) -> zenoh.Session:
    """Return the Zenoh session of a stranger."""
    config = zenoh.Config()
    wishes: dict[str, Any] = {"mode": "peer", "scouting/multicast/enabled": False, "listen/endpoints": []}
    for key, value in {**wishes, **{f"{name}/endpoints": value for name, value in sections.items()}}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
