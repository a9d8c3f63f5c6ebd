"""Options in a ``sim://`` address, listed in ``docs/drivers.md``. Pure."""

from __future__ import annotations

from dataclasses import replace
from typing import Final
from urllib.parse import urlencode

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.sim.camera import BOTTOM_CAMERA, FPV_CAMERA, FRONT_CAMERA, CameraModel
from skyloop.sim.options import EVERY_ACTION, MOST_LAG_S, SimOptions
from skyloop.sim.vehicles import VEHICLES
from skyloop.vehicles.sim.firmware import REAL_TIME, AutopilotKind

CAMERAS: Final = {camera.name: camera for camera in (FRONT_CAMERA, BOTTOM_CAMERA, FPV_CAMERA)}
QUALITIES: Final = ("fast", "smooth", "best")
ALWAYS_NATIVE: Final = frozenset({"idle", "emergency_stop", "reset_emergency"})
KNOWN: Final = {
    *("world", "seed", "speed", "cameras", "width", "height", "fps", "latency", "noise", "wind", "battery"),
    *("quality", "native", "position", "velocity", "truth", "rate", "vehicle"),
    *("autopilot", "autopilot_folder"),
}
AUTOPILOT_VEHICLES: Final = {
    AutopilotKind.ARDUPILOT: "iris",
    AutopilotKind.BETAFLIGHT: "racer",
    AutopilotKind.CRAZYFLIE: "crazyflie",
    AutopilotKind.PX4: "iris",
}
#: Firmware on the computer's clock can't catch up: world time would fall behind, and images would appear old.
REAL_TIME_LAG_S: Final = 0.02  #: lag beyond which steps are skipped with such firmware
TRUTH_HZ: Final = 100.0  #: rate at which the ground truth is stored alongside the firmware's state


def options_of(uri: VehicleUri) -> SimOptions:
    """Parse an address; raise UsageError if an option is unknown, invalid or does not fit the others."""
    if "process" in uri.options:
        raise UsageError(f"{uri}: process=none is an option of skyloop.connect(), which removes it: leave it out here")
    autopilot = _autopilot(uri)
    if autopilot is None:
        reject_unknown_options(uri, KNOWN)
    if uri.place:
        raise UsageError(f"{uri}: a simulated drone has no host; did you mean sim://?world={uri.place}")
    options, world = uri.options, uri.reveal("world")
    quality = options.get("quality", "smooth")
    if quality not in QUALITIES:
        raise UnknownNameError("quality of pictures", quality, QUALITIES)
    vehicle = options.get("vehicle", "quadrotor" if autopilot is None else AUTOPILOT_VEHICLES[autopilot])
    if vehicle not in VEHICLES:
        raise UnknownNameError("simulated vehicle", vehicle, VEHICLES)
    if autopilot is not None and VEHICLES[vehicle].rotors is None:
        raise UsageError(f"{uri}: firmware needs a vehicle with rotors, such as vehicle=iris, not {vehicle}")
    speed = uri.number("speed", 1.0, minimum=0.01, maximum=100.0)
    if autopilot in REAL_TIME and speed != 1.0:
        raise UsageError(f"{uri}: {autopilot.capitalize()} uses the computer's clock: speed must be 1, not {speed:g}")
    noise = uri.number("noise", 1.0, minimum=0.0, maximum=20.0)
    return SimOptions(
        world="room" if world is None else world,
        seed=uri.whole("seed", 0),
        speed=speed,
        cameras=tuple(_camera(uri, model, noise) for model in _models(options.get("cameras", "front,bottom"))),
        noise=noise,
        wind=uri.number("wind", 1.0, minimum=0.0, maximum=20.0),
        battery=uri.number("battery", 1.0, minimum=0.001, maximum=1.0),
        quality=quality,
        native=_native(options.get("native")),
        position=options.get("position") != "none" and uri.flag("position", default=True),
        velocity=options.get("velocity") != "none" and uri.flag("velocity", default=True),
        truth=uri.flag("truth", default=True),
        rate_hz=TRUTH_HZ if autopilot is not None else uri.number("rate", 40.0, minimum=1.0, maximum=200.0),
        most_lag_s=REAL_TIME_LAG_S if autopilot in REAL_TIME else MOST_LAG_S,
        parameters=VEHICLES[vehicle],
        autopilot=None if autopilot is None else autopilot.value,
        autopilot_folder=uri.reveal("autopilot_folder"),
    )


def firmware_options(uri: VehicleUri) -> str:
    """Return the options for the firmware's driver as a query string."""
    own = KNOWN - {"rate"}
    return urlencode({name: uri.reveal(name) for name in uri.options if name not in own}, safe="/,:")


def _autopilot(uri: VehicleUri) -> AutopilotKind | None:
    given = uri.options.get("autopilot")
    if given is None:
        if "autopilot_folder" in uri.options:
            raise UsageError(f"{uri}: autopilot_folder is for real firmware: give autopilot=… as well")
        return None
    known = [kind.value for kind in AutopilotKind]
    if given not in known:
        raise UnknownNameError("autopilot of sim://", given, known)
    for name in ("native", "velocity"):
        if name in uri.options:
            raise UsageError(f"{uri}: {name} is an option of the built-in autopilot, but {given} flies: remove it")
    return AutopilotKind(given)


def _models(text: str) -> list[CameraModel]:
    names = [] if text in ("none", "") else text.split(",")
    for name in names:
        if name not in CAMERAS:
            raise UnknownNameError("simulated camera", name, CAMERAS)
    if len(set(names)) != len(names):
        raise UsageError(f"cameras={text} names a camera twice")
    return [CAMERAS[name] for name in names]


def _camera(uri: VehicleUri, standard: CameraModel, noise: float) -> CameraModel:
    """Return the standard camera with another size, cutting or adding rows but keeping the horizontal field of view."""
    width = uri.whole("width", 0, minimum=16, maximum=4096)
    height = uri.whole("height", 0, minimum=16, maximum=4096)
    width = width or (round(height * standard.width / standard.height) if height else standard.width)
    model = standard.scaled(width / standard.width)
    if height and height != model.height:
        model = replace(model, height=height, cy=model.cy + (height - model.height) / 2)
    return replace(
        model,
        fps=uri.number("fps", standard.fps, minimum=0.1, maximum=240.0),
        latency_s=uri.number("latency", standard.latency_s, minimum=0.0, maximum=5.0),
        noise_sigma=standard.noise_sigma * noise,
    )


def _native(text: str | None) -> frozenset[str]:
    if text is None:
        return EVERY_ACTION
    names = set(text.split(","))
    for name in names - EVERY_ACTION:
        raise UnknownNameError("action", name, EVERY_ACTION)
    if not names & {"velocity", "attitude"}:
        raise UsageError(f"native={text} contains no set-point: add velocity or attitude")
    if ("takeoff" in names) != ("land" in names):
        raise UsageError(f"native={text}: takeoff and land go together")
    return frozenset(names) | ALWAYS_NATIVE
