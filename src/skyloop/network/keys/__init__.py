"""A lab's keys: who may join the network, and what each may do there.

A lab has one certificate authority, a folder (:mod:`skyloop.network.keys.lab`) that issues identities. An identity is a
folder, too, to copy to its machine; :func:`skyloop.network.keys.credentials.load` reads and checks one.
"""

from __future__ import annotations

from skyloop.network.keys.agreement import KeyRing
from skyloop.network.keys.credentials import Credentials, Entry, Roster, load
from skyloop.network.keys.identity import Identity, KeyRole
from skyloop.network.keys.lab import Lab

__all__ = ["Credentials", "Entry", "Identity", "KeyRing", "KeyRole", "Lab", "Roster", "load"]
