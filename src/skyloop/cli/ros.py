"""``skyloop ros``: exposes drones as ROS 2 nodes."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

from skyloop.cli import interrupt_by_signals
from skyloop.cli.naming import DronesOption, KeysOption, NamesArgument, NetworkOption, drones, join_network


def ros(
    names: NamesArgument = None,
    drone: DronesOption = None,
    priority: Annotated[
        int | None,
        typer.Option(
            metavar="P",
            min=0,
            max=31,
            help="Priority for requesting the authority at once [default: by the service authority/request]",
        ),
    ] = None,
    cmd_vel_timeout: Annotated[
        float, typer.Option(metavar="S", min=0.05, max=5.0, help="Time without cmd_vel after which the drone hovers")
    ] = 0.5,
    map_frame: Annotated[
        str, typer.Option("--map", metavar="FRAME", help="Join the drones' odom frames, if they share their axes")
    ] = "",
    use_sim_time: Annotated[bool, typer.Option("--use-sim-time", help="Use the time of /clock")] = False,
    domain: Annotated[
        str | None, typer.Option(metavar="ID", help="DDS domain, 0 to 101 [ROS_DOMAIN_ID]", show_default=False)
    ] = None,
    subnet: Annotated[
        bool, typer.Option("--subnet", help="Let other machines find it: ROS 2 has no keys, anyone in range can fly")
    ] = False,
    ros_args: Annotated[
        str, typer.Option(metavar="ARGS", help='For ROS 2, in quotes: --ros-args "-r cmd_vel:=teleop"')
    ] = "",
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Show drones to ROS 2: images, state and transforms as topics; fly with cmd_vel and services. Until Ctrl-C.

    Each drone is a namespace, such as /alpha. It is visible only on this machine, unless --subnet or the ROS 2
    variables change this. Drones flown by this command land when the command ends.
    """
    from skyloop.ros import Bridge, Settings
    from skyloop.vehicles.ros2.node import domain_of

    join_network(network, keys)
    settings = Settings(
        drones=tuple(drones(names, drone)),
        priority=priority,
        timeout_s=cmd_vel_timeout,
        map_frame=map_frame,
        use_sim_time=use_sim_time,
        domain=domain_of(domain),
        subnet=subnet,
        arguments=tuple(shlex.split(ros_args)),
    )
    interrupt_by_signals()
    try:
        with Bridge(settings) as bridge:
            for name, namespace in bridge.namespaces.items():
                typer.echo(f"ready /{namespace}: {name}, {bridge.drones[name].uri}")
            bridge.run()
    except KeyboardInterrupt:
        pass  # this is the normal way to stop
