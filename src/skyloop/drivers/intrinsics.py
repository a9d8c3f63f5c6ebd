"""A camera's intrinsics as options of a vehicle's address.

``calibration`` names the file of a calibration; or ``fx``, ``fy``, ``cx``, ``cy`` [px] and ``distortion``
(k1, k2, p1, p2[, k3[, k4, k5, k6]]) give the numbers.
"""

from __future__ import annotations

from typing import Final

from skyloop.calibration import Calibration, load_calibration
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.messages import Intrinsics

INTRINSICS_OPTIONS: Final = frozenset({"calibration", "fx", "fy", "cx", "cy", "distortion"})


def check_intrinsics(uri: VehicleUri) -> None:
    """Check the intrinsics of an address.

    Raises:
        UsageError: An option makes no sense, options don't go together, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        _calibration(uri)
    else:
        intrinsics_of(uri, 1, 1)


def intrinsics_of(uri: VehicleUri, width: int, height: int) -> Intrinsics | None:
    """Return the intrinsics of an address for frames of a size.

    Args:
        uri: The vehicle's address.
        width: [px]
        height: [px]

    Returns:
        None unless the address gives the focal length, or a calibration made with frames of this shape.

    Raises:
        UsageError: An option makes no sense, options don't go together, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        calibration = _calibration(uri)
        return calibration.intrinsics_for(width, height) if calibration.fits(width, height) else None
    distortion = _distortion(uri)
    if "fx" not in uri.options:
        for option in sorted(INTRINSICS_OPTIONS & uri.options.keys()):
            raise UsageError(f"{uri}: option {option} needs fx as well")
        return None
    fx = uri.number("fx", 0.0, minimum=1e-3)
    return Intrinsics(
        fx=fx,
        fy=uri.number("fy", fx, minimum=1e-3),
        cx=uri.number("cx", (width - 1) / 2),
        cy=uri.number("cy", (height - 1) / 2),
        distortion=distortion,
    )


def _calibration(uri: VehicleUri) -> Calibration:
    for option in sorted(INTRINSICS_OPTIONS & uri.options.keys() - {"calibration"}):
        raise UsageError(f"{uri}: option {option} does not go with calibration, which has it already")
    return load_calibration(uri.reveal("calibration") or "")


def _distortion(uri: VehicleUri) -> tuple[float, ...]:
    given = uri.options.get("distortion", "")
    try:
        numbers = tuple(float(part) for part in given.split(",")) if given else ()
    except ValueError:
        numbers = (0.0,)
    if len(numbers) not in (0, 4, 5, 8):
        raise UsageError(f"{uri}: distortion is {given!r} and must be 4, 5 or 8 numbers: k1,k2,p1,p2[,k3[,k4,k5,k6]]")
    return numbers
