"""The application's side: :func:`connect` gives a :class:`Drone`."""

from skyloop.client.authority import AuthorityState, AuthorityStatus
from skyloop.client.config import Config
from skyloop.client.connect import connect
from skyloop.client.delivery import Listener, Processor
from skyloop.client.drone import Drone
from skyloop.client.frame import Frame
from skyloop.client.gather import swarm
from skyloop.client.link import RedialPolicy
from skyloop.client.logbook import Logbook
from skyloop.client.monitor import Thresholds
from skyloop.client.reception import LinkStatus
from skyloop.client.results import Result
from skyloop.client.statistics import ChannelStats, Distribution
from skyloop.client.swarm import Swarm
from skyloop.client.takeover import TakeoverRequest

#: Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.
Stats = dict[str, ChannelStats]

__all__ = [
    "AuthorityState",
    "AuthorityStatus",
    "ChannelStats",
    "Config",
    "Distribution",
    "Drone",
    "Frame",
    "LinkStatus",
    "Listener",
    "Logbook",
    "Processor",
    "RedialPolicy",
    "Result",
    "Stats",
    "Swarm",
    "TakeoverRequest",
    "Thresholds",
    "connect",
    "swarm",
]
