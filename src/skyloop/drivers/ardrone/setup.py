"""What is done with a drone that was just heard, until it is ready: bootstrap, ids, mode, configuration. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final
from zlib import crc32

from skyloop.drivers.ardrone.configuration import Configurator, Ids, Read, Step, Write
from skyloop.drivers.ardrone.options import ArdroneOptions
from skyloop.wire.ardrone.configuration import format_value
from skyloop.wire.ardrone.navdata import State

_NEW_MOTHER_BOARD: Final = 32  #: of the AR.Drone 2; the AR.Drone 1 has 17 and less
_ID_KEYS: Final = {
    "session": "custom:session_id",
    "profile": "custom:profile_id",
    "application": "custom:application_id",
}


def version_of(configuration: Mapping[str, str]) -> int | None:
    """AR.Drone 1 or 2 by what its configuration says of firmware and mother board; None if it says neither."""
    major = configuration.get("general:num_version_soft", "").partition(".")[0]
    if major.isdecimal() and int(major) >= 1:
        return 1 if int(major) == 1 else 2
    board = configuration.get("general:num_version_mb", "")
    if board.isdecimal():
        return 2 if int(board) >= _NEW_MOTHER_BOARD else 1
    return None


def own_ids(session: int) -> Ids:
    """Ours: the settings of application and user last, those of a session begin anew with each number."""
    return Ids(
        session=f"{session & 0xFFFFFFFF:08x}",
        profile=f"{crc32(b'skyloop user'):08x}",
        application=f"{crc32(b'skyloop'):08x}",
    )


def ids_in_force(configuration: Mapping[str, str]) -> Ids | None:
    """Those that the drone names; None where it keeps nobody's settings apart."""
    if not all(key in configuration for key in _ID_KEYS.values()):
        return None
    return Ids(**{name: configuration[key] for name, key in _ID_KEYS.items()})


class Setup:
    """The steps for one drone. ``version`` is known when they are done, unless the drone does not tell it.

    ``remembered`` are keys that an application wrote before the drone went away: they are written again where the
    drone forgot them. ``refused_ids`` says afterwards that the drone took no settings of our own.
    """

    def __init__(
        self, options: ArdroneOptions, configurator: Configurator, ids: Ids, remembered: Mapping[str, str]
    ) -> None:
        self.version = options.version
        self.refused_ids = False
        self._options = options
        self._configurator = configurator
        self._ids = ids
        self._remembered = remembered

    def steps(self, state: State) -> Iterator[Step]:
        """For the configurator, which is to do each before it asks for the next. ``state`` as heard first."""
        options, configurator = self._options, self._configurator
        in_demo = bool(state & State.DEMO)
        if state & State.BOOTSTRAP or in_demo is options.full:
            yield Write("general:navdata_demo", format_value(not options.full))
        yield Read()
        self.version = options.version or version_of(configurator.values)
        if options.ids and self.version == 2:
            yield from self._take_ids()
        if options.navdata_options is not None:
            yield from self._written({"general:navdata_options": str(options.navdata_options)})
        yield from self._written(self._remembered)

    def _take_ids(self) -> Iterator[Step]:
        configurator = self._configurator
        present = ids_in_force(configurator.values)
        if present is None:
            return
        configurator.ids = present
        for name, key in _ID_KEYS.items():
            wanted = getattr(self._ids, name)
            if getattr(configurator.ids, name) != wanted:
                yield Write(key, wanted)
                configurator.ids = replace(configurator.ids, **{name: wanted})
        if configurator.ids != present:
            yield Read()
            configurator.ids = ids_in_force(configurator.values)
            self.refused_ids = configurator.ids != self._ids

    def _written(self, wanted: Mapping[str, str]) -> Iterator[Step]:
        different = {key: text for key, text in wanted.items() if self._configurator.values.get(key, text) != text}
        for key, text in different.items():
            yield Write(key, text)
        if different:
            yield Read()
