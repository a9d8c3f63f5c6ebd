# What `import skyloop` offers: each name of this table is imported from there when it is first used.

from skyloop import aio as aio
from skyloop.client import Authority as Authority
from skyloop.client import Drone as Drone
from skyloop.client import Frame as Frame
from skyloop.client import Network as Network
from skyloop.client import Result as Result
from skyloop.client import Swarm as Swarm
from skyloop.client import connect as connect
from skyloop.client import swarm as swarm
from skyloop.control import Controller as Controller
from skyloop.errors import AuthorityError as AuthorityError
from skyloop.errors import ClosedError as ClosedError
from skyloop.errors import LinkError as LinkError
from skyloop.errors import NoAnswerError as NoAnswerError
from skyloop.errors import RefusedError as RefusedError
from skyloop.errors import SkyloopError as SkyloopError
from skyloop.errors import SwarmError as SwarmError
from skyloop.errors import UnknownNameError as UnknownNameError
from skyloop.errors import UnsupportedError as UnsupportedError
from skyloop.errors import UsageError as UsageError
from skyloop.messages import Attitude as Attitude
from skyloop.messages import Event as Event
from skyloop.messages import EventKind as EventKind
from skyloop.messages import Feedback as Feedback
from skyloop.messages import FlightState as FlightState
from skyloop.messages import Points as Points
from skyloop.messages import Polyline as Polyline
from skyloop.messages import Position as Position
from skyloop.messages import Text as Text
from skyloop.messages import Velocity as Velocity
from skyloop.motion_capture import mocap as mocap
from skyloop.recording import record as record

__version__: str
