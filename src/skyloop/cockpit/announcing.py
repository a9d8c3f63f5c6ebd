"""Says where the page is, to the person at the terminal."""

from __future__ import annotations

import ipaddress
import sys
from urllib.parse import urlsplit

from skyloop.cockpit.access import PAIRING_S, Pairing
from skyloop.cockpit.addresses import qr_code


class Announcer:
    """Prints the page's address, and a QR code for phones where others reach it and a terminal can show one.

    The address of the QR code has a code to pair with, if there are any, after the ``#``: browsers send that part to
    nobody. The next one is printed as soon as it was used, or is too old.

    Args:
        pairing: Gives the codes; None: none is needed, or people have tokens.
        loopback: Whether only this machine reaches it.
    """

    def __init__(self, pairing: Pairing | None, loopback: bool) -> None:
        self._pairing = pairing
        self._loopback = loopback

    def __call__(self, page: str) -> None:
        """Print it."""
        print(f"cockpit: {page}", flush=True)
        if self._pairing is not None:
            self._pairing.on_used = lambda who: self._show(page, f"paired with {who}")
            self._pairing.on_expired = lambda: self._show(page, "the address to pair with is too old now")
        if not self._loopback and ipaddress.ip_address(urlsplit(page).hostname or "").is_loopback:
            print("cockpit: this machine is in no network: nobody else reaches the page", file=sys.stderr)
        self._show(page, "")

    def _show(self, page: str, before: str) -> None:
        if self._pairing is not None:
            if before:
                print(before, flush=True)
            page = f"{page}#pair={self._pairing.code()}"
            print(
                f"to pair a browser, open this within {PAIRING_S / 60:.0f} minutes; it works once: {page}", flush=True
            )
        if sys.stdout.isatty() and (self._pairing is not None or not self._loopback):
            print(qr_code(page), flush=True)
