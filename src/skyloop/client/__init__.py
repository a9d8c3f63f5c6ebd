"""The application's side of the connection: :func:`skyloop.connect` returns a :class:`skyloop.Drone`."""

from skyloop.client.authority import Authority as Authority
from skyloop.client.authority import AuthorityState as AuthorityState
from skyloop.client.authority import AuthorityStatus as AuthorityStatus
from skyloop.client.authority import TakeoverRequest as TakeoverRequest
from skyloop.client.channels import Listener as Listener
from skyloop.client.connect import Network as Network
from skyloop.client.connect import connect as connect
from skyloop.client.connection import RedialPolicy as RedialPolicy
from skyloop.client.drone import Drone as Drone
from skyloop.client.frame import Frame as Frame
from skyloop.client.monitoring import ChannelStats as ChannelStats
from skyloop.client.monitoring import Distribution as Distribution
from skyloop.client.monitoring import Thresholds as Thresholds
from skyloop.client.parameters import Config as Config
from skyloop.client.preflight import Level as Level
from skyloop.client.preflight import PreflightFinding as PreflightFinding
from skyloop.client.publishing import Logbook as Logbook
from skyloop.client.results import Result as Result
from skyloop.client.swarm import Swarm as Swarm
from skyloop.client.swarm import swarm as swarm
from skyloop.client.telemetry import LinkStatus as LinkStatus

#: Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.
Stats = dict[str, ChannelStats]

__all__ = [name for name in dir() if name[0].isupper() or name in ("connect", "swarm")]
