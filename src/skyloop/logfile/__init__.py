"""The former address of the part of :mod:`skyloop.recording` that reads files: programs may still import from here."""

import sys
from importlib import import_module

# Their modules are these under another name, so that classes are the same by both.
for _name in ("layout", "pictures", "reader"):
    sys.modules[f"{__name__}.{_name}"] = globals()[_name] = import_module(f"skyloop.recording.{_name}")
