"""The emulated firmware's log variables and parameters: names, types, defaults, and the variables' values. Pure.

Groups, names, types and defaults are those that a Crazyflie 2.1 with a Flow deck, a Multi-ranger deck and an AI deck
reports. Groups of single controllers and filters are left out. Variables without a value here are always 0.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from skyloop.messages.geometry import turned
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.sim.reports import VehicleFeedback
from skyloop.sim.world import Vec3
from skyloop.vehicles.crazyflie.wire.contents import ContentsInfo, Entry, ValueType

#: Log variables: a group, then types, each followed by names.
LOG: Final = """
crtp: uint16 rxRate txRate
radio: uint8 rssi isConnected uint16 numRxBc numRxUc
sys: int8 testLogParam uint8 canfly isFlying isTumbled
supervisor: uint16 info
pm: float vbat uint16 vbatMV float extVbat uint16 extVbatMV float extCurr chargeCurrent int8 state uint8 batteryLevel
memTst: uint32 errCntW
locSrv: float x y z qx qy qz qw
locSrvZ: uint16 tick
ext_pos: float X Y Z
motor: int32 m1req m2req m3req m4req uint16 m1 m2 m3 m4
stateEstimate: float x y z vx vy vz ax ay az roll pitch yaw qx qy qz qw
stateEstimateZ: int16 x y z vx vy vz ax ay az uint32 quat int16 rateRoll ratePitch rateYaw
controller: int16 ctr_yaw float cmd_thrust cmd_roll cmd_pitch cmd_yaw actuatorThrust roll pitch yaw rollRate pitchRate
controller: float yawRate
mag: float x y z
gyro: float x y z
acc: float x y z
baro: float asl temp pressure
stabilizer: float roll pitch yaw thrust rtStab uint32 intToOut
ctrltarget: float x y z vx vy vz ax ay az roll pitch yaw
ctrltargetZ: int16 x y z vx vy vz ax ay az
posEstAlt: float estimatedZ estVZ velocityZ
kalman: float stateX stateY stateZ statePX statePY statePZ stateD0 stateD1 stateD2 varX varY varZ varPX varPY varPZ
kalman: float varD0 varD1 varD2 q0 q1 q2 q3 rtUpdate rtPred rtFinal
range: uint16 front back up left right zrange
motion: uint8 motion int16 deltaX deltaY uint16 shutter uint8 maxRaw minRaw Rawsum uint16 outlierCount uint8 squal
motion: float std
posCtl: float targetVX targetVY targetVZ targetX targetY targetZ bodyVX bodyVY bodyX bodyY
lighthouse: uint8 status uint16 bsReceive bsActive bsAvailable
"""

#: Parameters: a group, then types, each followed by names. ``=``: default, ``*``: persistent, ``!``: read only.
PARAMETERS: Final = """
system: uint8 storageStats storageReformat int8 selftestPassed!=1 uint8 assertInfo testLogParam taskDump int8 arm
imu_sensors: uint8 BMP388!=1 imu_tests: uint8 MPU6500!=1
crtpsrv: uint16 echoDelay
memTst: uint8 resetW
supervisor: uint8 infdmp uint16 landedTimeout*=3000
stabilizer: uint8 stop estimator=2 controller=1
commander: uint8 enHighLevel
flightmode: uint8 althold poshold posSet yawMode=2 stabModeRoll=1 stabModePitch=1 stabModeYaw
cppm: float rateRoll*=720 ratePitch*=720 angPitch*=50 angRoll*=50 rateYaw*=400
locSrv: uint8 enRangeStreamFP32 enLhAngleStream float extPosStdDev=0.01 extQuatStdDev=0.0045
sensfusion6: float kp*=0.8 ki*=0.002 baseZacc=1
kalman: uint8 resetEstimation robustTdoa robustTwr float pNAcc_xy*=0.5 pNAcc_z*=1 pNVel* pNPos* pNAtt* mNBaro*=2
kalman: float mNGyro_rollpitch*=0.1 mNGyro_yaw*=0.1 initialX initialY initialZ initialYaw maxPos=100 maxVel=10
pid_rate: float roll_kp*=250 roll_ki*=500 roll_kd*=2.5 roll_kff* pitch_kp*=250 pitch_ki*=500 pitch_kd*=2.5 pitch_kff*
pid_rate: float yaw_kp*=120 yaw_ki*=16.7 yaw_kd* yaw_kff* int8 rateFiltEn*
pid_attitude: float roll_kp*=6 roll_ki*=3 roll_kd* roll_kff* pitch_kp*=6 pitch_ki*=3 pitch_kd* pitch_kff* yaw_kp*=6
pid_attitude: float yaw_ki*=1 yaw_kd*=0.35 yaw_kff* yawMaxDelta* int8 attFiltEn*
posCtlPid: float xKp*=2 xKi* xKd* xKff* yKp*=2 yKi* yKd* yKff* zKp*=2 zKi*=0.5 zKd* zKff* uint16 thrustBase*=36000
posCtlPid: uint16 thrustMin*=20000 float rLimit*=20 pLimit*=20 xVelMax*=1 yVelMax*=1 zVelMax*=1
velCtlPid: float vxKp*=25 vxKi*=1 vxKd* vxKFF* vyKp*=25 vyKi*=1 vyKd* vyKFF* vzKp*=25 vzKi*=15 vzKd* vzKFF*
ctrlMel: float kp_xy*=0.4 kd_xy*=0.2 ki_xy*=0.05 kp_z*=1.25 kd_z*=0.4 ki_z*=0.05 mass*=0.027 massThrust*=132000
powerDist: uint32 idleThrust*
quadSysId: float thrustToTorque=0.005964552 armLength=0.046
hlCommander: float vtoff=0.5 vland=0.5 uint8 groupmask
motorPowerSet: uint8 enable uint16 m1 m2 m3 m4
ring: uint8 effect*=6 neffect! solidRed=20 solidGreen=20 solidBlue=20 headlightEnable float emptyCharge fullCharge=1
ring: uint32 fadeColor float fadeTime=0.5
led: uint8 bitmask
sound: uint8 effect uint32 neffect! uint16 freq=4000 uint8 ratio
deck: uint8 bcFlow2!=1 bcFlow! bcMultiranger!=1 bcAI!=1 bcZRanger! bcZRanger2! bcLedRing! bcBuzzer! bcLighthouse4!
deck: uint8 bcLoco! bcDWM1000! bcUSD! bcOA! bcBigQuad! bcGTGPS! bcServo! bcActiveMarker!
motion: uint8 disable adaptive
lighthouse: uint8 method=1 bsCalibReset systemType=2 uint16 bsAvailable
pm: float lowVoltage*=3.2 criticalLowVoltage*=3
firmware: uint32 revision0!=1783442688 uint16 revision1!=27555 uint8 modified!
"""


@dataclass(frozen=True, slots=True)
class Row:
    """A log variable or parameter, as in the tables above."""

    entry: Entry
    default: float


def rows(text: str) -> Iterator[Row]:
    group, kind = "", ValueType.UINT8
    number = 0
    for word in text.split():
        if word.endswith(":"):
            group = word[:-1]
        elif word.upper() in ValueType.__members__:
            kind = ValueType[word.upper()]
        else:
            name, _, default = word.partition("=")
            flags = name[len(name.rstrip("*!")) :]
            entry = Entry(number, group, name.rstrip("*!"), kind, "!" in flags, "*" in flags)
            yield Row(entry, kind.decode(kind.encode(float(default or 0))))
            number += 1


LOG_ROWS: Final = tuple(rows(LOG))
PARAMETER_ROWS: Final = tuple(rows(PARAMETERS))


def info_of(table: Iterable[Row], max_blocks: int = 0, max_variables: int = 0) -> ContentsInfo:
    """Return a table's size and fingerprint."""
    entries = [row.entry for row in table]
    return ContentsInfo(len(entries), zlib.crc32(repr(entries).encode()), max_blocks, max_variables)


# Values of log variables ---------------------------------------------------------------------------------------------

OUT_OF_RANGE_MM: Final = 32767  #: what range finders report without an echo
_NO_CHARGER, _LOW_POWER = 0, 3  # states of the power management: on battery, and nearly empty
_LOW_V: Final = 3.2
VARIANCE: Final = 1e-4  #: variance of a settled position, which the estimate always is


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What the log variables show at one instant. Positions and yaw are those of the vehicle's own estimate."""

    believed: VehicleFeedback
    place_m: Vec3
    yaw_rad: float
    quaternion: tuple[float, float, float, float]
    target_m: Vec3
    target_velocity_m_s: Vec3
    target_yaw_rad: float
    supervisor: int  #: bits of :class:`~skyloop.vehicles.crazyflie.wire.commander.Supervisor`
    thrust: float  #: from 0 to 1
    external_m: Vec3  #: newest position from outside
    ranges_mm: dict[str, int]
    packed_quaternion: int


def values(snapshot: Snapshot) -> dict[str, float]:
    """Return the values of all variables that are not constant. Pitch is positive with the nose up, as in firmware."""
    believed = snapshot.believed
    x, y, z = snapshot.place_m
    forward, left, up = believed.velocity_m_s
    vx, vy = turned(forward, left, snapshot.yaw_rad)
    rates = [math.degrees(rate) for rate in believed.angular_velocity_rad_s]
    acc = [part / GRAVITY_M_S2 for part in believed.acceleration_m_s2]
    roll, pitch, yaw = map(math.degrees, (believed.roll_rad, -believed.pitch_rad, snapshot.yaw_rad))
    qx, qy, qz, qw = snapshot.quaternion
    motor = round(65535 * max(0.0, min(1.0, snapshot.thrust)))
    found: dict[str, float] = {
        "radio.rssi": 40,
        "radio.isConnected": 1,
        "sys.canfly": snapshot.supervisor >> 3 & 1,
        "sys.isFlying": snapshot.supervisor >> 4 & 1,
        "sys.isTumbled": snapshot.supervisor >> 5 & 1,
        "supervisor.info": snapshot.supervisor,
        "pm.vbat": believed.battery_v,
        "pm.vbatMV": round(1000 * believed.battery_v),
        "pm.state": _LOW_POWER if believed.battery_v < _LOW_V else _NO_CHARGER,
        "pm.batteryLevel": max(0, min(100, round(100 * believed.battery))),
        "baro.asl": 100.0 + z,
        "baro.temp": 25.0,
        "baro.pressure": 1001.3,
        "stabilizer.roll": roll,
        "stabilizer.pitch": pitch,
        "stabilizer.yaw": yaw,
        "stabilizer.thrust": motor,
        "posEstAlt.estimatedZ": z,
        "posEstAlt.velocityZ": up,
        "controller.cmd_thrust": motor,
        "controller.actuatorThrust": motor,
        "motion.squal": 100,
        "lighthouse.status": 0,
    }
    found |= {f"motor.m{n}": motor for n in range(1, 5)} | {f"motor.m{n}req": motor for n in range(1, 5)}
    found |= {f"range.{name}": value for name, value in snapshot.ranges_mm.items()}
    found |= {f"kalman.var{name}": VARIANCE for name in ("X", "Y", "Z", "PX", "PY", "PZ")}
    estimate = {"x": x, "y": y, "z": z, "vx": vx, "vy": vy, "vz": up}
    estimate |= dict(zip(("ax", "ay", "az"), (*turned(acc[0], acc[1], snapshot.yaw_rad), acc[2] - 1), strict=True))
    found |= {f"stateEstimate.{name}": value for name, value in estimate.items()}
    found |= {f"stateEstimate.{name}": value for name, value in zip(("roll", "pitch", "yaw"), (roll, pitch, yaw))}  # noqa: B905
    found |= {f"stateEstimate.q{axis}": value for axis, value in zip("xyzw", (qx, qy, qz, qw), strict=True)}
    found |= {f"stateEstimateZ.{name}": _small(1000 * value) for name, value in estimate.items()}
    found["stateEstimateZ.quat"] = snapshot.packed_quaternion
    for name, rate in zip(("Roll", "Pitch", "Yaw"), (rates[0], -rates[1], rates[2]), strict=True):
        found[f"stateEstimateZ.rate{name}"] = _small(1000 * math.radians(rate))
    for axis, state, velocity in zip("XYZ", (x, y, z), (forward, left, up), strict=True):
        found[f"kalman.state{axis}"], found[f"kalman.stateP{axis}"] = state, velocity
    found |= {f"kalman.q{n}": value for n, value in enumerate((qw, qx, qy, qz))}
    for n, axis in enumerate("xyz"):
        found[f"gyro.{axis}"], found[f"acc.{axis}"] = rates[n], acc[n]
        found[f"locSrv.{axis}"] = found[f"ext_pos.{axis.upper()}"] = snapshot.external_m[n]
        target, speed = snapshot.target_m[n], snapshot.target_velocity_m_s[n]
        found[f"ctrltarget.{axis}"], found[f"ctrltarget.v{axis}"] = target, speed
        found[f"ctrltargetZ.{axis}"], found[f"ctrltargetZ.v{axis}"] = _small(1000 * target), _small(1000 * speed)
        found[f"posCtl.target{axis.upper()}"], found[f"posCtl.targetV{axis.upper()}"] = target, speed
    found["ctrltarget.yaw"] = found["controller.yaw"] = math.degrees(snapshot.target_yaw_rad)
    return found


def _small(value: float) -> int:
    """Return a value as an int16, limited."""
    return max(-32768, min(32767, round(value)))
