"""Flight by a learned policy: a network in an ONNX file that maps an image and the state to a set-point."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import STALE_S
from skyloop.control.behaviour import BLIND_S, Behaviour
from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.extend import let_go
from skyloop.messages import Attitude, Feedback, Text, Velocity
from skyloop.messages.relayed import Shape
from skyloop.messages.rows import ACTIONS, STATE, set_point, state_row
from skyloop.vision.lens import pixels_of
from skyloop.vision.onnx import load_network, reason
from skyloop.vision.opencv import opencv

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

# Names of the network's inputs and outputs, and keys of its metadata.
STATE_INPUT: Final = "observation.state"
IMAGE_INPUT: Final = "observation.images."
OUTPUT: Final = "action"
MEMORY: Final = "memory"
NEXT_MEMORY: Final = "next_memory"  #: output that becomes the memory input for the next image
STATE_NAMES: Final = "skyloop.state"  #: metadata key for a JSON list of the names of state values
ACTION_NAMES: Final = "skyloop.action"  #: metadata key for the names of action values
_MOST_SIDE: Final = 4096  # maximum side of an input image [px]
_MOST_MEMORY: Final = 2**20  # maximum number of values in the memory
_PURPOSE: Final = "flying by an ONNX file"


class PolicyPhase(StrEnum):
    """Whether a policy is flying and, if not, why."""

    FLYING = "flying"
    NO_STATE = "the drone does not report all values that the policy needs: hovering"
    NO_ACTION = "the policy's action is not finite: hovering"


class PolicyNetwork:
    """A policy's network. Call it from one thread only.

    The network has an input ``observation.images.CAMERA``, float32 (1, 3, height, width), with red, green and blue from
    0 to 1, and may have an input ``observation.state``, float32 (1, n). Its output is ``action``, (1, m). Names and
    values match those of ``skyloop log export --to lerobot``. The metadata ``skyloop.state`` and ``skyloop.action``
    list the values' names in JSON. A network with memory has an input ``memory``, float32 of a fixed shape, and an
    output ``next_memory`` of the same shape, which becomes ``memory`` for the next image. The memory is initially zero.

    Args:
        path: The ONNX file.
        state: Names of the state values, from :data:`~skyloop.messages.rows.STATE`; None to read the metadata.
        action: ``velocity`` or ``attitude``; None to read the metadata.
        threads: CPU threads for one run, 1 to 64.

    Attributes:
        camera: Name of the camera whose images the network was trained on.
        size: Width and height of input images [px]; other images are scaled.
        state: Names of the state values.
        action: ``velocity`` or ``attitude``.

    Raises:
        MissingExtraError: ONNX Runtime or OpenCV is not installed.
        UnknownNameError: The name of a state value or of the action is unknown.
        UsageError: There is no such file, or an argument is out of range or contradicts the file.
        FileFormatError: The file is not an ONNX file, or its inputs, outputs or metadata are not as described above.
    """

    def __init__(
        self, path: Path | str, *, state: Sequence[str] | None = None, action: str | None = None, threads: int = 1
    ) -> None:
        self._path = Path(path)
        if not self._path.is_file():
            raise UsageError(f"there is no file {path}: give the ONNX file of a policy")
        if isinstance(threads, bool) or not isinstance(threads, int) or not 1 <= threads <= 64:
            raise UsageError(f"threads is {threads!r} and must be a whole number from 1 to 64")
        self._cv = opencv(_PURPOSE)
        self._errors, self._session = load_network(self._path, threads, _PURPOSE)
        metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        inputs = {each.name: each for each in self._session.get_inputs()}
        self._image, self.camera, self.size = self._picture(inputs)
        self.state = self._state(inputs, state, metadata)
        self.action = self._action(action, metadata)
        outputs = [each.name for each in self._session.get_outputs()]
        if outputs.count(OUTPUT) != 1:
            raise FileFormatError(f"{path} must have one output with the name {OUTPUT}")
        self._outputs = [OUTPUT, *([NEXT_MEMORY] if MEMORY in inputs else [])]
        self._blank = self._memory_of(inputs, outputs)
        self._memory = self._blank
        self(np.zeros((self.size[1], self.size[0], 3), np.uint8), [0.0] * len(self.state))
        self.forget()

    def __call__(self, image: NDArray[np.uint8], state: Sequence[float]) -> Velocity | Attitude:
        """Compute the set-point and store the network's memory for the next image.

        Args:
            image: A BGR image, (height, width, 3), or grey image, (height, width), uint8, of any size.
            state: Values in the order of :attr:`state`.

        Returns:
            The set-point, whose values may not be finite.

        Raises:
            FileFormatError: The network can't be run, or its action has the wrong number of values.
        """
        if image.ndim == 2:
            image = self._cv.cvtColor(image, self._cv.COLOR_GRAY2BGR)
        if (image.shape[1], image.shape[0]) != self.size:
            image = self._cv.resize(image, self.size, interpolation=self._cv.INTER_AREA)
        planes = np.stack(self._cv.split(image)[::-1])
        feed: dict[str, Any] = {self._image: np.divide(planes[None], np.float32(255), dtype=np.float32)}
        if self.state:
            feed[STATE_INPUT] = np.array([state], np.float32)
        if self._memory is not None:
            feed[MEMORY] = self._memory
        try:
            row, *kept = self._session.run(self._outputs, feed)
        except self._errors as error:
            raise FileFormatError(f"{self._path} can't be run: {reason(error)}") from error
        self._remember(kept)
        values = np.asarray(row, np.float64).ravel()
        try:
            return set_point(self.action, values.tolist())
        except UsageError as error:
            raise FileFormatError(f"{self._path}: {error}") from None

    def forget(self) -> None:
        """Clear the memory, so that the next image is treated as the first."""
        self._memory = self._blank

    def _remember(self, kept: Sequence[NDArray[np.float32]]) -> None:
        if self._blank is None:
            return
        (memory,) = kept
        if memory.shape != self._blank.shape:
            raise FileFormatError(
                f"{self._path} takes {MEMORY} as {self._blank.shape} and gives {NEXT_MEMORY} as {memory.shape}: "
                "the two must match"
            )
        # Non-finite values would stay in the memory forever.
        self._memory = memory if np.isfinite(memory).all() else self._blank

    def _memory_of(self, inputs: Mapping[str, Any], outputs: Sequence[str]) -> NDArray[np.float32] | None:
        """Return the initial memory; None if the network has no memory."""
        if (MEMORY in inputs) != (NEXT_MEMORY in outputs):
            raise FileFormatError(
                f"{self._path} must have both the input {MEMORY} and the output {NEXT_MEMORY}, or neither"
            )
        if MEMORY not in inputs:
            return None
        shape, kind = list(inputs[MEMORY].shape), inputs[MEMORY].type
        fixed = all(isinstance(each, int) and each > 0 for each in shape)
        if not fixed or math.prod(shape) > _MOST_MEMORY or kind != "tensor(float)":
            raise FileFormatError(
                f"{self._path} takes {MEMORY} as {kind} {tuple(shape)}, but must take float32 of a fixed shape with "
                f"at most {_MOST_MEMORY} values"
            )
        return np.zeros(shape, np.float32)

    def _picture(self, inputs: Mapping[str, Any]) -> tuple[str, str, tuple[int, int]]:
        pictures = [name for name in inputs if name.startswith(IMAGE_INPUT)]
        others = [name for name in inputs if name not in (*pictures, STATE_INPUT, MEMORY)]
        if len(pictures) != 1 or others:
            raise FileFormatError(
                f"{self._path} has the inputs {', '.join(inputs) or 'none'}, but must have one image, "
                f"{IMAGE_INPUT}CAMERA, and may have {STATE_INPUT} and {MEMORY}"
            )
        (name,) = pictures
        shape = list(inputs[name].shape)
        sized = len(shape) == 4 and all(isinstance(each, int) and 0 < each <= _MOST_SIDE for each in shape[1:])
        if not sized or shape[1] != 3 or inputs[name].type != "tensor(float)":
            raise FileFormatError(
                f"{self._path} takes {name} as {inputs[name].type} {tuple(shape)}, but must take float32 of shape "
                f"(1, 3, height, width), with at most {_MOST_SIDE} pixels on each side"
            )
        return name, name.removeprefix(IMAGE_INPUT), (shape[3], shape[2])

    def _state(
        self, inputs: Mapping[str, Any], given: Sequence[str] | None, metadata: Mapping[str, str]
    ) -> tuple[str, ...]:
        if STATE_INPUT not in inputs:
            if given:
                raise UsageError(f"{self._path} takes no {STATE_INPUT}: leave state out")
            return ()
        names = tuple(given) if given is not None else self._names(STATE_NAMES, metadata)
        for name in names:
            if name not in STATE:
                raise UnknownNameError("state value", name, STATE)
        shape = inputs[STATE_INPUT].shape
        if len(shape) != 2 or (isinstance(shape[1], int) and shape[1] != len(names)):
            raise FileFormatError(
                f"{self._path} takes {STATE_INPUT} as {tuple(shape)}, not (1, {len(names)}): {', '.join(names)}"
            )
        return names

    def _action(self, given: str | None, metadata: Mapping[str, str]) -> str:
        if given is not None:
            if given not in ACTIONS:
                raise UnknownNameError("action of a policy", given, ACTIONS)
            return given
        names = self._names(ACTION_NAMES, metadata)
        for kind, own in ACTIONS.items():
            if names == own:
                return kind
        raise FileFormatError(f"{self._path} names the action {', '.join(names)}, but must name {_ACTIONS}")

    def _names(self, key: str, metadata: Mapping[str, str]) -> tuple[str, ...]:
        try:
            names = json.loads(metadata[key])
        except (KeyError, ValueError, RecursionError):
            names = None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            argument = "state" if key == STATE_NAMES else "action"
            raise FileFormatError(f"{self._path} has no JSON list of names as {key} in its metadata: give {argument}=")
        return tuple(names)


_ACTIONS: Final = " or ".join(f"{kind} ({', '.join(names)})" for kind, names in ACTIONS.items())


class OnnxPolicy(Behaviour):
    """Flies by a learned policy: for each frame, a network computes a set-point from the image and the state.

    The proxy's limits, zones and failsafe apply as they do for any application. The vehicle hovers, and an event
    reports why, if no frames arrive, if a state value that the network needs is missing or over half a second old, or
    if the action is not finite. In each case the network's memory is cleared. The vehicle must be airborne when
    :meth:`run` is called. All callbacks run on the thread that called :meth:`run`.
    """

    name = "policy"
    losses = frozenset({PolicyPhase.NO_STATE, PolicyPhase.NO_ACTION})

    def __init__(
        self,
        drone: Drone,
        path: Path | str,
        *,
        camera: str | None = None,
        state: Sequence[str] | None = None,
        action: str | None = None,
        threads: int = 1,
    ) -> None:
        """Load the network.

        Args:
            drone: The drone to fly.
            path: The ONNX file; see :class:`PolicyNetwork`.
            camera: Camera to use; None for the camera named in the file.
            state: Names of the state values, if not stated in the file.
            action: ``velocity`` or ``attitude``; needed if the file does not state which.
            threads: CPU threads for one image.

        Raises:
            MissingExtraError: ONNX Runtime or OpenCV is not installed.
            UsageError: There is no such file, or an argument is out of range.
            UnknownNameError: The vehicle has no such camera, or a name is unknown.
            FileFormatError: The file is not a policy.
        """
        self.network = PolicyNetwork(path, state=state, action=action, threads=threads)
        self._newest = _Newest()
        super().__init__(drone, self._newest, self.network.camera if camera is None else camera)
        self._phase = PolicyPhase.FLYING
        self._looked_at_ns = 0  # capture time of the newest frame given to the network

    @property
    def phase(self) -> PolicyPhase:
        """The current phase, which tells whether the policy is flying and, if not, why."""
        return self._phase

    def look(self, frame: Frame) -> list[Shape]:
        """Compute the set-point for a frame and annotate the frame with it."""
        if frame.captured_ns - self._looked_at_ns > nanoseconds(BLIND_S):
            self.network.forget()
        self._looked_at_ns = frame.captured_ns
        believed = frame.feedback
        old = believed is None or seconds(frame.captured_ns - believed.captured_ns) > STALE_S
        row = None if believed is None or (old and self.network.state) else state_row(believed, self.network.state)
        if row is None:
            self._phase, self._newest.wanted = PolicyPhase.NO_STATE, Velocity()
            self.network.forget()
            return [Text(self._phase, (8.0, 16.0))]
        wanted = self.network(pixels_of(frame), row)
        self._phase = PolicyPhase.FLYING if wanted.finite else PolicyPhase.NO_ACTION
        self._newest.wanted = wanted if wanted.finite else Velocity()
        if not wanted.finite:
            self.network.forget()
        return [self._written(self._newest.wanted)]

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send the set-point, or hover if there is none."""
        if self._phase is PolicyPhase.FLYING:
            super().steer(wanted)
        else:
            let_go(self.drone, "the policy gives no action")

    def _written(self, wanted: Velocity | Attitude) -> Text:
        names = ACTIONS[self.network.action]
        return Text(" ".join(f"{name} {getattr(wanted, name, 0.0):+.2f}" for name in names), (8.0, 16.0))


class _Newest:
    """The control law of a behaviour whose set-points are computed in :meth:`Behaviour.look`."""

    def __init__(self) -> None:
        self.wanted: Velocity | Attitude = Velocity()

    def feedback(self, feedback: Feedback) -> None:
        pass

    def step(self, now_ns: int) -> Velocity | Attitude:  # noqa: ARG002  (the signature of a law)
        return self.wanted
