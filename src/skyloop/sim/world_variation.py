"""What a world file leaves to the seed: where things stand that carry ``vary`` or ``vary_yaw_deg``."""

from __future__ import annotations

import math

import numpy as np

from skyloop.sim.streams import Purpose, stream
from skyloop.sim.world_tables import BoxTable, GateTable, SpawnTable, WorldTable
from skyloop.toml_file import Place

_TRIES = 400  # for one thing's place
_BEGINNINGS = 100  # of the whole: the first ones may have left no room for the last

Varied = BoxTable | GateTable | SpawnTable


def place_varied(table: WorldTable, seed: int, place: Place) -> None:
    """Move what varies to places that the seed decides, uniformly within its ranges.

    Raises:
        FileFormatError: There is no room for all of it at the distance ``apart``.
    """
    things = _varied(table)
    if not things:
        return
    random = stream(seed, Purpose.LAYOUT)
    for _ in range(_BEGINNINGS):
        places = _places(things, table.vary.apart, random)
        if places is not None:
            break
    else:
        raise place.under("vary").error(
            "apart", f"no room was found for {len(things)} things at {table.vary.apart:g} m from each other"
        )
    for thing, (x, y, z) in zip(things, places, strict=True):
        if isinstance(thing, BoxTable) and thing.stands_at is not None:
            thing.stands_at = (x, y)
        else:
            thing.position = (x, y, z)
        thing.yaw_deg = float(thing.yaw_deg + random.uniform(-1.0, 1.0) * thing.vary_yaw_deg)


def _varied(table: WorldTable) -> list[Varied]:
    things: list[Varied] = [*table.gate, *table.box, *table.spawn]
    return [thing for thing in things if (any(thing.vary) or thing.vary_yaw_deg) and _centre(thing) is not None]


def _places(things: list[Varied], apart_m: float, random: np.random.Generator) -> list[tuple[float, ...]] | None:
    """Return a position for each thing, or None when one found no room."""
    places: list[tuple[float, ...]] = []
    for thing in things:
        centre = _centre(thing)
        for _ in range(_TRIES if centre else 0):
            x, y, z = (np.array(centre) + random.uniform(-1.0, 1.0, 3) * thing.vary).tolist()
            if all(math.dist((x, y), other[:2]) >= apart_m for other in places):
                places.append((x, y, z))
                break
        else:
            return None
    return places


def _centre(thing: Varied) -> tuple[float, float, float] | None:
    """Return where it is written; None of a box without a place, which is refused later, by name."""
    if isinstance(thing, BoxTable) and thing.stands_at is not None:
        return (*thing.stands_at, 0.0)
    return thing.position
