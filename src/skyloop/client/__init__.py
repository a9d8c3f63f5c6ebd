"""The application's side: :func:`skyloop.connect` returns a :class:`skyloop.Drone`."""

from skyloop.client.authority import Authority, AuthorityState, AuthorityStatus, TakeoverRequest
from skyloop.client.channels import Listener
from skyloop.client.connect import Network, connect
from skyloop.client.connection import RedialPolicy
from skyloop.client.drone import Drone
from skyloop.client.frame import Frame
from skyloop.client.monitoring import ChannelStats, Distribution, Thresholds
from skyloop.client.parameters import Config
from skyloop.client.preflight import Level, PreflightFinding
from skyloop.client.publishing import Logbook
from skyloop.client.results import Result
from skyloop.client.swarm import Swarm, swarm
from skyloop.client.telemetry import LinkStatus

#: Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.
Stats = dict[str, ChannelStats]

__all__ = [
    "Authority",
    "Network",
    "AuthorityState",
    "AuthorityStatus",
    "ChannelStats",
    "Config",
    "Distribution",
    "Drone",
    "Frame",
    "Level",
    "LinkStatus",
    "Listener",
    "Logbook",
    "PreflightFinding",
    "RedialPolicy",
    "Result",
    "Stats",
    "Swarm",
    "TakeoverRequest",
    "Thresholds",
    "connect",
    "swarm",
]
