"""The drone's configuration: its values per session, user and application, and dumps of them. Pure."""

from __future__ import annotations

import re
from typing import Final

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire.configuration import (
    DEFAULT_ID,
    END_OF_DUMP,
    Category,
    Key,
    Value,
    VideoChannel,
    VideoCodec,
    format_dump,
    keys_of,
    parse_value,
)

MOST_CUSTOM: Final = 16  #: maximum number of sessions, of users and of applications; a real drone's limit is unknown

Ids = tuple[str, str, str]  #: ids of the session, user and application, as in ``CONFIG_IDS``

_ID: Final = re.compile(r"[0-9a-f]{8}")
_ID_KEYS: Final = {
    "custom:session_id": Category.SESSION,
    "custom:profile_id": Category.USER,
    "custom:application_id": Category.APPLICATION,
}
_DESCRIPTIONS: Final = {
    Category.APPLICATION: ("[applis]", "custom:application_desc"),
    Category.USER: ("[profiles]", "custom:profile_desc"),
    Category.SESSION: ("[sessions]", "custom:session_desc"),
}
#: Limits with separate keys for indoors and outdoors, besides the key for the limit in force.
PLACE_LIMITS: Final = ("euler_angle_max", "control_vz_max", "control_yaw")
#: Values in the emulated firmware (2.4.8 and 1.7.4) that differ from the usual defaults.
_FACTORY: Final[dict[int, dict[str, Value]]] = {
    1: {
        "general:num_version_soft": "1.7.4",
        "general:num_version_mb": 17,
        "network:ssid_single_player": "ardrone",
        "network:ssid_multi_player": "ardrone",
        "video:camif_fps": 15,
        "video:video_codec": VideoCodec.UVLC.value,
    },
    2: {"general:num_version_soft": "2.4.8"},
}
_CODECS: Final = {1: (VideoCodec.UVLC,), 2: tuple(codec for codec in VideoCodec if codec >= VideoCodec.MP4_360P)}
_CHANNELS: Final = {1: 4, 2: 2}  # number of video channels by version; each channel carries one camera or a pair


class Configuration:
    """All keys of an AR.Drone 1 or 2. Ignores invalid values received from clients and never raises.

    A number out of range is clamped; no source says what a real drone does in that case. A key in the category session,
    user or application has a separate value for each id; new ids begin with the factory values.
    """

    def __init__(self, version: int) -> None:
        self._version = version
        self._keys = keys_of(version)
        self._factory = {name: key.default for name, key in self._keys.items()} | _FACTORY[version]
        self._values: dict[Category, dict[str, dict[str, Value]]] = {
            category: {DEFAULT_ID: self._fresh(category)} for category in Category
        }
        self._ids = dict.fromkeys(Category, DEFAULT_ID)

    def __getitem__(self, name: str) -> Value:
        category = self._keys[name].category
        return self._values[category][self._ids[category]][name]

    def __contains__(self, name: str) -> bool:
        return name in self._keys

    def number(self, name: str) -> float:
        value = self[name]
        assert isinstance(value, int | float)
        return value

    @property
    def ids(self) -> Ids:
        """The ids of the current session, user and application."""
        return self._ids[Category.SESSION], self._ids[Category.USER], self._ids[Category.APPLICATION]

    def write(self, name: str, text: str, ids: Ids | None = None) -> bool:
        """Handle a ``CONFIG`` with the ids received immediately before it, if any; return whether it was accepted.

        While a custom session, user or application is active, only commands with its ids are accepted. The keys
        ``custom:…_id`` are exempt: otherwise no other client could ever start its own.
        """
        name = name.strip().lower()
        key = self._keys.get(name)
        if key is None or key.read_only:
            return False
        if name in _ID_KEYS:
            return self._choose(_ID_KEYS[name], text.strip().lower())
        expected = None if self.ids == (DEFAULT_ID,) * 3 and ids is None else self.ids
        if ids != expected:
            return False
        value = self._understood(key, text)
        if value is None:
            return False
        self._store(name, value)
        return True

    def forget_client(self) -> None:
        """Restore the default session, user and application after a link loss."""
        self._ids = dict.fromkeys(Category, DEFAULT_ID)
        self._show_ids()

    def dump(self) -> bytes:
        """Return the control port's reply to ``CTRL 4``."""
        return format_dump({name: self[name] for name in self._keys})

    def custom_ids(self) -> bytes:
        """Return the control port's reply to ``CTRL 6``."""
        parts = []
        for category, (title, description) in _DESCRIPTIONS.items():
            parts.append(title)
            parts += [
                f"{one_id},{values[description]}"
                for one_id, values in self._values[category].items()
                if one_id != DEFAULT_ID
            ]
        return "".join(part + "\r" for part in parts).encode("latin-1", "replace") + END_OF_DUMP

    def _fresh(self, category: Category) -> dict[str, Value]:
        return {name: self._factory[name] for name, key in self._keys.items() if key.category is category}

    def _store(self, name: str, value: Value) -> None:
        category = self._keys[name].category
        self._values[category][self._ids[category]][name] = value
        section, _, word = name.partition(":")
        place = "outdoor" if self["control:outdoor"] else "indoor"
        if name == "control:outdoor":
            for limit in PLACE_LIMITS:
                self._store(f"control:{limit}", self[f"control:{place}_{limit}"])
        elif section == "control" and word in PLACE_LIMITS:
            self._values[category][self._ids[category]][f"control:{place}_{word}"] = value
        elif section == "control" and word.removeprefix(f"{place}_") in PLACE_LIMITS:
            self._store(f"control:{word.removeprefix(f'{place}_')}", value)

    def _choose(self, category: Category, text: str) -> bool:
        """Start, switch to or delete (``-id``, ``-all``) a session, user or application."""
        known = self._values[category]
        if text == "-all":
            for gone in [one_id for one_id in known if one_id != DEFAULT_ID]:
                del known[gone]
        elif text.startswith("-") and text[1:] != DEFAULT_ID:
            known.pop(text[1:], None)
        elif not _ID.fullmatch(text) or (text not in known and len(known) > MOST_CUSTOM):
            return False
        else:
            known.setdefault(text, self._fresh(category))
            self._ids[category] = text
        if self._ids[category] not in known:
            self._ids[category] = DEFAULT_ID
        self._show_ids()
        return True

    def _show_ids(self) -> None:
        """Write the current ids to their keys, which belong to the session."""
        session = self._values[Category.SESSION][self._ids[Category.SESSION]]
        session.update({name: self._ids[category] for name, category in _ID_KEYS.items()})

    def _understood(self, key: Key, text: str) -> Value | None:
        """Parse the text of a key's value; return None if it is invalid."""
        try:
            value = parse_value(text, _as_number(key.default))
        except DecodeError:
            return None
        if isinstance(value, float) and isinstance(key.default, int):
            value = int(value)
        if isinstance(value, int | float) and not isinstance(value, bool):
            if key.low is not None and key.high is not None:
                value = type(value)(min(max(value, key.low), key.high))
            if key.choices and value not in key.choices:
                return None
        if key.name == "video:video_codec":
            return value if value in _CODECS[self._version] else None
        if key.name == "video:video_channel":
            return self._channel(value)
        return value

    def _channel(self, value: Value) -> Value | None:
        most = _CHANNELS[self._version]
        if value == VideoChannel.NEXT:
            return (int(self.number("video:video_channel")) + 1) % most
        return value if isinstance(value, int) and value < most else None


def _as_number(default: Value) -> Value:
    """Return a number as a float, because the firmware's C code allows a decimal point in whole numbers."""
    return float(default) if isinstance(default, int) and not isinstance(default, bool) else default
