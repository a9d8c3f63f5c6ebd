"""Loading of the user's processor from a module or a file, with errors that name the place and the problem."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from skyloop.control.loading import load_module
from skyloop.errors import FileFormatError, UnknownNameError, UsageError

_WANTED: Final = "a class with a method process(self, frame)"
_DIGITS: Final = 16  #: number of digits of the code's hash


@dataclass(frozen=True, slots=True)
class Code:
    """A processor's class, and a mark that distinguishes it from other code with the same name."""

    kind: type[Any]
    mark: str  #: name of the class and a hash of the file that defines it

    @classmethod
    def of(cls, kind: type[Any]) -> Code:
        """Return the code of a class.

        Raises:
            UsageError: The class has no plain method ``process(self, frame)``.
        """
        _check(kind)
        digits = hashlib.sha256(_source(kind)).hexdigest()[:_DIGITS]
        return cls(kind, f"{kind.__qualname__[:100]} {digits}")

    @property
    def name(self) -> str:
        """Default name of the processor: the name of the class in lower case."""
        return self.kind.__name__.lower()[:64]

    def make(self) -> Any:
        """Create an instance.

        Raises:
            UsageError: The class needs arguments.
        """
        try:
            inspect.signature(self.kind).bind()
        except TypeError as error:
            name = self.kind.__name__
            raise UsageError(f"{name} can't be made as {name}(): {error}; give its arguments default values") from None
        return self.kind()


def load_processor(target: str) -> Code:
    """Load a processor's class.

    Args:
        target: ``module:Class``, ``file.py:Class``, or ``file.py`` if it has only one processor. The current directory
            is searched for modules too.

    Raises:
        UsageError: ``target`` names no processor, there is no such module, or the class is not a processor.
        UnknownNameError: There is no such class.
        FileFormatError: Loading fails, or the file contains no processor.
    """
    place, colon, class_name = target.rpartition(":")
    if not colon:
        place, class_name = target, ""
    if place.endswith(".py"):
        module = load_module(Path(place), _WANTED)
    elif colon and place:
        module = _import(place)
    else:
        raise UsageError(f"{target!r} is not a processor: give module:Class, file.py:Class or file.py")
    return Code.of(_choose(module, class_name, place))


def _import(name: str) -> ModuleType:
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            raise UsageError(
                f"there is no module {name} here or on Python's path: give module:Class, or file.py:Class"
            ) from None
        raise FileFormatError(f"module {name}: {error}") from error
    except Exception as error:
        raise FileFormatError(f"module {name}: {type(error).__name__}: {error}") from error


def _choose(module: ModuleType, class_name: str, place: str) -> type[Any]:
    """Return the class with that name or, without a name, the only class with a method ``process``."""
    found = {
        name: value
        for name, value in vars(module).items()
        if inspect.isclass(value) and callable(getattr(value, "process", None))
    }
    if class_name:
        named = getattr(module, class_name, None)
        if inspect.isclass(named):
            return named
        raise UnknownNameError(f"processor in {place}", class_name, found)
    own = {name: value for name, value in found.items() if value.__module__ == module.__name__} or found
    if not own:
        raise FileFormatError(f"{place} has no processor: write {_WANTED}")
    if len(own) > 1:
        raise UsageError(f"{place} has several processors ({', '.join(sorted(own))}): choose one with {place}:CLASS")
    return next(iter(own.values()))


def _check(kind: type[Any]) -> None:
    process = getattr(kind, "process", None)
    if not callable(process):
        raise UsageError(f"{kind.__name__} is not a processor: it has no method process(self, frame)")
    if inspect.iscoroutinefunction(process):
        raise UsageError(f"{kind.__name__}.process must be a plain function, not a coroutine")
    try:
        inspect.signature(process).bind(None, None)
    except TypeError as error:
        raise UsageError(f"{kind.__name__}.process must take one frame, as process(self, frame): {error}") from None


def _source(kind: type[Any]) -> bytes:
    """Return the source file of a class or, if there is none (as in a notebook), its compiled code."""
    try:
        return Path(inspect.getsourcefile(kind) or "").read_bytes()
    except (TypeError, OSError):
        code = getattr(kind.process, "__code__", None)
        return b"" if code is None else code.co_code + repr(code.co_names).encode()
