"""A camera beside the autopilot: over the network, or a device of this machine."""

from __future__ import annotations

from functools import partial

from skyloop.drivers.base import Sink
from skyloop.drivers.camera_options import CameraSource, intrinsics_of, source_of
from skyloop.drivers.live_camera import LiveCamera, LiveCameraSettings
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import CameraInfo
from skyloop.messages.frame import H264
from skyloop.vehicles.mavlink.options import FACINGS, CameraOptions


def camera_info(uri: VehicleUri, options: CameraOptions) -> CameraInfo:
    """Return the camera as it is announced before the first picture: from the network most send H.264."""
    return CameraInfo(
        options.name,
        options.width,
        options.height,
        options.fps,
        intrinsics=intrinsics_of(uri, options.width, options.height),
        rotation=FACINGS[options.facing],
        stream=H264 if options.stream and source(uri, options).scheme else "",
    )


def source(uri: VehicleUri, options: CameraOptions) -> CameraSource:
    """Return where the camera's video comes from.

    Raises:
        UsageError: Its address is neither a stream's nor a device.
    """
    return source_of(options.source, f"{uri}: camera")


def camera_receiver(uri: VehicleUri, options: CameraOptions, sink: Sink) -> LiveCamera:
    """Return a receiver of the camera, not started.

    Args:
        uri: The vehicle's address, with the intrinsics.
        options: Of the camera.
        sink: The proxy's.
    """
    settings = LiveCameraSettings(
        source(uri, options),
        options.name,
        options.width,
        options.height,
        options.fps,
        stream=options.stream,
        purpose="a camera beside the autopilot",
    )
    return LiveCamera(settings, sink, partial(intrinsics_of, uri))
