"""One folder for each vehicle: its driver, the pure part of its protocol (``wire``), and its ``emulator``.

``docs/drivers.md`` shows how to write one. A driver is found by its entry point, never imported by the core.
"""
