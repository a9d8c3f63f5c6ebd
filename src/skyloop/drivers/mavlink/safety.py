"""The autopilots' own safety nets: which of them are off, and what to set. Pure.

Both autopilots do nothing by default when this computer or its link dies, but drop the last set-point. What a value
does was observed on the real autopilots or stands in their parameter references.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.drivers.mavlink.dialects import CopterDialect, Dialect
from skyloop.drivers.seams import Remark

Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Rule:
    """``good``: whether the value of this parameter is as it should be."""

    name: str
    what: str
    good: Callable[[float], bool]
    otherwise: str  #: what comes of another value
    advice: str


def _on(value: float) -> bool:
    return value != 0


_COPTER: Final = (
    _Rule("FS_GCS_ENABLE", "loss of this computer", _on, "it hovers until its battery is empty", "fs_gcs_enable=7"),
    _Rule("FS_GCS_TIMEOUT", "time to that", lambda s: s <= 5, "it takes longer than 5 s", "fs_gcs_timeout=5"),
    _Rule("GUID_TIMEOUT", "loss of set-points", lambda s: 0 < s <= 3, "it flies on for long", "guid_timeout=1"),
    _Rule("FS_EKF_ACTION", "loss of its place", _on, "nothing happens", "fs_ekf_action=1"),
    _Rule("BATT_FS_LOW_ACT", "low battery", _on, "nothing happens", "batt_fs_low_act=1"),
    _Rule("FENCE_ENABLE", "fence", _on, "there is none", "fence_enable=1"),
)
_PX4: Final = (
    _Rule("NAV_DLL_ACT", "loss of this computer", _on, "nothing more happens", "nav_dll_act=1"),
    _Rule("COM_DL_LOSS_T", "time to that", lambda s: s <= 10, "it takes longer than 10 s", "com_dl_loss_t=5"),
    _Rule("COM_OF_LOSS_T", "time to miss set-points", lambda s: s <= 1, "it flies on for long", "com_of_loss_t=1"),
    _Rule(
        "COM_OBL_RC_ACT",
        "loss of set-points",
        lambda action: action in (3, 4, 5),
        "without a remote control it sinks to the ground",
        "com_obl_rc_act=5",
    ),
    _Rule("COM_LOW_BAT_ACT", "low battery", _on, "there is no more than a warning", "com_low_bat_act=2"),
    _Rule("GF_MAX_VER_DIST", "ceiling", lambda height: height > 0, "there is none", "gf_max_ver_dist=30"),
)


def remarks_of(dialect: Dialect, values: Values, own_system: int) -> list[Remark]:
    """A remark for each safety net that this autopilot has a parameter for."""
    found = [_judged(rule, values[rule.name]) for rule in _rules(dialect) if rule.name in values]
    listens = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if isinstance(dialect, CopterDialect) and listens is not None and listens != own_system:
        detail = f"it counts heartbeats of system {listens:g} and we are system {own_system}: our loss is not noticed"
        found.append(Remark("ground station", False, detail, f"give the address ?own_sysid={listens:g}"))
    return found


def _rules(dialect: Dialect) -> tuple[_Rule, ...]:
    return _COPTER if isinstance(dialect, CopterDialect) else _PX4


def _judged(rule: _Rule, value: float) -> Remark:
    detail = f"{rule.name} is {value:g}"
    if rule.good(value):
        return Remark(rule.what, True, detail)
    return Remark(rule.what, False, f"{detail}: {rule.otherwise}", f"set the parameter mavlink.{rule.advice}")
