"""One folder per vehicle, with its driver, the pure part of its protocol (``wire``) and its ``emulator``.

``docs/drivers.md`` explains how to write a driver. The core finds drivers by their entry points and never imports them.
"""
