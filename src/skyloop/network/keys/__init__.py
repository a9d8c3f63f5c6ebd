"""A lab's keys. They determine who may join the network, and what each member may do there.

A lab has one certificate authority, stored in a folder (:mod:`skyloop.network.keys.lab`). It issues identities. Each
identity also has a folder, for its machine; :func:`skyloop.network.keys.credentials.load` reads and checks it.
"""

from __future__ import annotations

from skyloop.network.keys.agreement import KeyRing
from skyloop.network.keys.credentials import Credentials, Entry, Roster, load
from skyloop.network.keys.identity import Identity, KeyRole
from skyloop.network.keys.lab import Lab

__all__ = ["Credentials", "Entry", "Identity", "KeyRing", "KeyRole", "Lab", "Roster", "load"]
