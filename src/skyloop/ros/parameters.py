"""The parameters of a drone as parameters of its node."""

from __future__ import annotations

from typing import Any

from skyloop.client import Drone
from skyloop.errors import SkyloopError
from skyloop.messages import Event, EventKind, Parameter, ParameterType, Value


class Parameters:
    """Declares the drone's parameters at a node, writes what ROS sets, and shows what others set.

    Args:
        node: Of rclpy. Setting one waits for the drone's proxy.
        drone: Connected as a pilot: writing needs the authority.
    """

    def __init__(self, node: Any, drone: Drone) -> None:
        self._node = node
        self._drone = drone
        self._known: dict[str, Parameter] = {each.name: each for each in drone.config.parameters()}
        for each in self._known.values():
            node.declare_parameter(each.name, _to_ros(each.value), _described(each))
        node.add_on_set_parameters_callback(self._set)
        drone.on_event(self._on_event)

    def _set(self, parameters: list[Any]) -> Any:
        """Write what differs; the first that is refused ends it, with the proxy's reason."""
        from rcl_interfaces.msg import SetParametersResult

        for each in parameters:
            known = self._known.get(each.name)
            if known is None or _same(known.value, each.value):
                continue  # the node's own, or what others have set already
            try:
                self._drone.config[each.name] = each.value
                self._known[each.name] = self._drone.config.describe(each.name)
            except SkyloopError as error:
                return SetParametersResult(successful=False, reason=error.reason)
        return SetParametersResult(successful=True)

    def _on_event(self, event: Event) -> None:
        """Show what was written elsewhere. On a thread of the drone's own."""
        name = event.data.get("name")
        if event.kind is not EventKind.PARAMETER_CHANGED or name not in self._known:
            return
        from rclpy.parameter import Parameter as RosParameter

        try:
            changed = self._drone.config.describe(str(name))
        except SkyloopError as error:
            self._node.get_logger().warning(f"{name} was changed, but can't be read: {error.reason}")
            return
        self._known[changed.name] = changed
        if not _same(changed.value, self._node.get_parameter(changed.name).value):
            self._node.set_parameters([RosParameter(changed.name, value=_to_ros(changed.value))])


def _described(parameter: Parameter) -> Any:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{parameter.unit}]" if parameter.unit else ""
    once = " (momentary: writing it does something once)" if parameter.momentary else ""
    descriptor = ParameterDescriptor(description=f"{parameter.description}{unit}{once}")
    if parameter.read_only:
        descriptor.additional_constraints = "read-only"
    elif parameter.choices:
        descriptor.additional_constraints = f"one of {', '.join(map(str, parameter.choices))}"
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if parameter.type is ParameterType.FLOAT:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif parameter.type is ParameterType.INT:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor


def _to_ros(value: Value) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _same(ours: Value, theirs: Any) -> bool:
    return bool(_to_ros(ours) == (theirs if isinstance(theirs, bool | int | float | str) else list(theirs)))
