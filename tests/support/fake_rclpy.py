"""The parts of rclpy and its messages that Skyloop uses, without DDS: tests read and deliver the messages."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from enum import Enum, auto
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class Message:
    """A message of any type, whose fields are created on first use."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name.isupper():
            raise AttributeError(name)
        made: Any = [] if name in ("poses", "transforms") else "" if name == "frame_id" else Message()
        self.__dict__[name] = made
        return made


class Publisher:
    def __init__(self) -> None:
        self.published: list[Any] = []
        self.subscribers = 1

    def publish(self, message: Any) -> None:
        self.published.append(message)

    def get_subscription_count(self) -> int:
        return self.subscribers

    @property
    def newest(self) -> Any:
        return self.published[-1]


class Logger:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def _log(self, text: str, **_how: Any) -> None:
        self.lines.append(text)

    info = warning = error = _log


class Future:
    """The future of a service call, answered by the test."""

    def __init__(self) -> None:
        self.callback: Callable[[Any], None] | None = None
        self.answer: Any = None
        self.error: Exception | None = None

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self.callback = callback

    def finish(self, answer: Any = None, error: Exception | None = None) -> None:
        self.answer, self.error = answer, error
        assert self.callback is not None
        self.callback(self)

    def exception(self) -> Exception | None:
        return self.error

    def cancelled(self) -> bool:
        return False

    def result(self) -> Any:
        return self.answer


class Client:
    def __init__(self) -> None:
        self.ready = True
        self.calls: list[Future] = []

    def service_is_ready(self) -> bool:
        return self.ready

    def call_async(self, _request: Any) -> Future:
        self.calls.append(Future())
        return self.calls[-1]


class Node:
    def __init__(self, name: str, namespace: str, overrides: list[Any]) -> None:
        self.name = name
        self.namespace = namespace
        self.publishers: dict[str, Publisher] = {}
        self.subscriptions: dict[str, Callable[[Any], None]] = {}
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.clients: dict[str, Client] = {}
        self.parameters: dict[str, Any] = {each.name: each.value for each in overrides}
        self.descriptors: dict[str, Any] = {}
        self.timers: list[Callable[[], None]] = []
        self.logger = Logger()
        self.now_ns = 10**18
        self.on_set: Callable[[list[Any]], Any] | None = None
        self.destroyed = False

    def create_publisher(self, _kind: type, topic: str, _quality: Any) -> Publisher:
        self.publishers[topic] = Publisher()
        return self.publishers[topic]

    def create_subscription(self, _kind: type, topic: str, callback: Callable[[Any], None], _quality: Any) -> str:
        self.subscriptions[topic] = callback
        return topic

    def destroy_subscription(self, topic: str) -> None:
        del self.subscriptions[topic]

    def create_service(
        self, _kind: type, name: str, callback: Callable[[Any, Any], Any], callback_group: Any = None
    ) -> None:
        self.services[name] = callback

    def create_client(self, _kind: type, name: str) -> Client:
        self.clients[name] = Client()
        return self.clients[name]

    def create_timer(self, _period_s: float, callback: Callable[[], None], clock: Any) -> None:
        self.timers.append(callback)

    def call(self, service: str, request: Any = None) -> Any:
        return self.services[service](request, Message())

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> None:
        self.parameters[name], self.descriptors[name] = value, descriptor

    def add_on_set_parameters_callback(self, callback: Callable[[list[Any]], Any]) -> None:
        self.on_set = callback

    def set_parameters(self, parameters: list[Any]) -> Any:
        assert self.on_set is not None
        result = self.on_set(parameters)
        if result.successful:
            self.parameters.update({each.name: each.value for each in parameters})
        return result

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.parameters[name])

    def get_logger(self) -> Logger:
        return self.logger

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))

    def destroy_node(self) -> None:
        self.destroyed = True


class ExternalShutdownException(Exception):  # noqa: N818  as rclpy calls it
    pass


class Executor:
    def __init__(self, *_arguments: Any, **_options: Any) -> None:
        self._ended = threading.Event()

    def add_node(self, node: Node) -> None:
        pass

    def spin(self) -> None:
        self._ended.wait(30)
        raise ExternalShutdownException

    def shutdown(self, timeout_sec: float) -> None:
        self._ended.set()


class Fake:
    """What a test can access: the nodes by name."""

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self.arguments: list[str] = []
        self.refuses: Exception | None = None


class Choice(Enum):
    BEST_EFFORT = auto()
    TRANSIENT_LOCAL = auto()
    STEADY_TIME = auto()
    NO = auto()


def _parameter(name: str, value: Any = None) -> Any:
    return SimpleNamespace(name=name, value=value)


@pytest.fixture
def rclpy(monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Install the fake, and return its nodes."""
    fake = Fake()

    class Context:
        def ok(self) -> bool:
            return True

        def destroy(self) -> None:
            pass

    def init(args: list[str], **_options: Any) -> None:
        fake.arguments = args
        if fake.refuses is not None:
            raise fake.refuses

    def create_node(name: str, namespace: str, parameter_overrides: list[Any], **_options: Any) -> Node:
        fake.nodes[name] = Node(name, namespace, parameter_overrides)
        return fake.nodes[name]

    def any_of(*names: str) -> dict[str, Any]:
        return {name: type(name, (Message,), {}) for name in names}

    trigger = type("Trigger", (), {"Request": Message})
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {
            "Context": Context,
            "Parameter": _parameter,
            "init": init,
            "create_node": create_node,
            "shutdown": lambda context: None,
        },
        "rclpy.qos": {
            "qos_profile_sensor_data": "sensor data",
            "QoSProfile": SimpleNamespace,
            "ReliabilityPolicy": Choice,
            "DurabilityPolicy": Choice,
        },
        "rclpy.clock": {"Clock": SimpleNamespace, "ClockType": Choice},
        "rclpy.signals": {"SignalHandlerOptions": Choice},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": SimpleNamespace},
        "rclpy.parameter": {"Parameter": _parameter},
        "rclpy.executors": {
            "ExternalShutdownException": ExternalShutdownException,
            "MultiThreadedExecutor": Executor,
            "SingleThreadedExecutor": Executor,
        },
        "geometry_msgs": {},
        "geometry_msgs.msg": any_of("Twist", "TwistStamped", "PoseStamped"),
        "nav_msgs": {},
        "nav_msgs.msg": any_of("Odometry"),
        "nav_msgs.srv": any_of("GetPlan"),
        "sensor_msgs": {},
        "sensor_msgs.msg": any_of("CameraInfo", "CompressedImage", "Image", "Imu"),
        "std_msgs": {},
        "std_msgs.msg": any_of("String"),
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": trigger},
        "rcl_interfaces": {},
        "rcl_interfaces.msg": any_of(
            "FloatingPointRange", "IntegerRange", "ParameterDescriptor", "SetParametersResult"
        ),
        "tf2_msgs": {},
        "tf2_msgs.msg": any_of("TFMessage"),
    }
    constants = {
        "BatteryState": {"POWER_SUPPLY_STATUS_DISCHARGING": 2},
        "NavSatFix": {"COVARIANCE_TYPE_APPROXIMATED": 1},
        "NavSatStatus": {"STATUS_FIX": 0, "SERVICE_GPS": 1},
    }
    modules["sensor_msgs.msg"] |= {name: type(name, (Message,), known) for name, known in constants.items()}
    for name, members in modules.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return fake
