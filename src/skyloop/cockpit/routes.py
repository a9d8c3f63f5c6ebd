"""The page's routes: files in one folder, and checked routes that are ready to fly."""

from __future__ import annotations

import hashlib
import re
from collections import OrderedDict
from pathlib import Path
from typing import Any, Final

import msgspec

from skyloop.control.route import ENDING, Route, RouteCheck, checked, load_route, save_route
from skyloop.errors import RefusedError, SkyloopError, UnknownNameError, UsageError

MOST_FILES: Final = 200  #: maximum number of routes in the folder
MOST_CHECKED: Final = 16  #: maximum number of checked routes per drone; the one checked longest ago is dropped first
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.-]{0,47}")

Json = dict[str, Any]


class RouteFiles:
    """A folder of routes, created when needed, each in a file ``NAME.route.json``. Its methods block: use a thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def listing(self) -> Json:
        """Return the routes as JSON values, by name; for an unreadable file, return the problem instead."""
        return {"folder": str(self.folder), "routes": [self._entry(path) for path in self._files()[:MOST_FILES]]}

    def load(self, name: str) -> Route:
        """Read a route; raise ``UnknownNameError`` without one, another ``SkyloopError`` if name or file is invalid."""
        path = self._path(name)
        if not path.is_file():
            raise UnknownNameError("route", name, [one.name.removesuffix(ENDING) for one in self._files()])
        return load_route(path)

    def save(self, name: str, route: Route) -> None:
        """Write a route, replacing any route with the same name.

        Raise ``UsageError`` if the name is invalid or the file can't be written, and ``RefusedError`` if there are
        already :data:`MOST_FILES` routes.
        """
        path = self._path(name)
        if not path.exists() and len(self._files()) >= MOST_FILES:
            raise RefusedError(f"{MOST_FILES} routes are kept in {self.folder}: delete one first")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{self.folder} can't be created: {error.strerror or error}") from None
        save_route(msgspec.structs.replace(route, name=name), path)

    def delete(self, name: str) -> None:
        """Delete a route.

        Raise ``UnknownNameError`` if there is no route with that name, and ``UsageError`` if the name is invalid or the
        file can't be deleted.
        """
        path = self._path(name)
        try:
            path.unlink()
        except FileNotFoundError:
            raise UnknownNameError("route", name, [one.name.removesuffix(ENDING) for one in self._files()]) from None
        except OSError as error:
            raise UsageError(f"{path} can't be deleted: {error.strerror or error}") from None

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob(f"*{ENDING}")) if self.folder.is_dir() else []

    def _path(self, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise UsageError(f"{name!r:.60} is not a valid route name: up to 48 letters, digits, spaces and _ . -")
        return self.folder / f"{name}{ENDING}"

    def _entry(self, path: Path) -> Json:
        name = path.name.removesuffix(ENDING)
        try:
            return {"name": name, "waypoints": len(load_route(path).waypoints), "problem": None}
        except SkyloopError as error:
            return {"name": name, "waypoints": None, "problem": str(error)}


class CheckedRoutes:
    """One drone's most recently checked routes, by a hash of their content; only checked routes can be flown."""

    def __init__(self) -> None:
        self._routes: OrderedDict[str, Route] = OrderedDict()

    def add(self, route: Route, check: RouteCheck) -> Json:
        """Store a route; return the check's findings as JSON values, with the ``id`` used to fly the route."""
        number = hashlib.sha256(checked(route).to_json()).hexdigest()[:16]
        self._routes[number] = route
        self._routes.move_to_end(number)
        while len(self._routes) > MOST_CHECKED:
            self._routes.popitem(last=False)
        return {"id": number, "ok": check.ok, **msgspec.to_builtins(check)}

    def get(self, number: str) -> Route:
        """Return a checked route; raise ``RefusedError`` if it was not checked, or too many have been checked since."""
        if number not in self._routes:
            raise RefusedError("this route was not checked recently: check it again")
        return self._routes[number]
