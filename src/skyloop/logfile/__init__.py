"""The former import path of :mod:`skyloop.recording`'s file readers, kept for existing programs."""

import sys
from importlib import import_module

# Alias the modules, so that classes are identical under both names.
for _name in ("layout", "pictures", "reader"):
    sys.modules[f"{__name__}.{_name}"] = globals()[_name] = import_module(f"skyloop.recording.{_name}")
