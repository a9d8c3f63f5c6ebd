"""Networks loaded from ONNX files and run on the CPU by ONNX Runtime or, for trackers, by OpenCV.

A network file is an untrusted program: before it is loaded here, a child process loads and runs it within limits.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from skyloop.errors import FileFormatError, MissingExtraError

CPU_S: Final = 20  #: limit of CPU time for loading a network and running it once
MEMORY: Final = 4 << 30  #: limit of the address space [bytes], on top of four times the file's size
_WAIT_S: Final = 300.0  # wall-clock limit, long enough for a busy computer
_REFUSED: Final = 3  # exit code of a child that printed the reason
_OWN: Final = Path(__file__).with_name("weights")
#: The child uses this process's module path, not the working directory, which may hold untrusted files.
_CHILD: Final = (
    "import sys; sys.path[:] = sys.argv[3:]; "
    "from skyloop.vision.onnx import run_alone; run_alone(int(sys.argv[1]), *sys.argv[2].splitlines())"
)


def load_network(path: Path, threads: int, purpose: str) -> tuple[tuple[type[Exception], ...], Any]:
    """Load a network after a child process has loaded and run it on zeros within :data:`CPU_S` and :data:`MEMORY`.

    Return the exceptions that a run can raise, and ONNX Runtime's session. ``purpose`` is a noun phrase for the error
    message. Raises FileFormatError if ONNX Runtime can't load the file within the limits.
    """
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as state
    except ImportError as error:
        raise MissingExtraError(purpose, "detect", cause=str(error)) from error
    own = [each for each in vars(state).values() if isinstance(each, type) and issubclass(each, Exception)]
    errors: tuple[type[Exception], ...] = (*own, RuntimeError, ValueError, TypeError)
    if path.parent != _OWN:
        try_alone(path)
    try:
        return errors, _session(onnxruntime, path, threads)
    except errors as error:
        raise FileFormatError(f"{path} can't be loaded as an ONNX file: {reason(error)}") from error


def _session(onnxruntime: Any, path: Path | str, threads: int) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # the exception states the reason
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def try_alone(*files: Path | str, tracker: str = "") -> None:
    """Load and run a network in a child process within limits, or raise FileFormatError.

    ``tracker`` names the OpenCV tracker that loads the one or two files; without it, ONNX Runtime loads the file.
    """
    path, job = ", ".join(map(str, files)), "\n".join(map(str, (tracker, *files)))
    command = [sys.executable, "-c", _CHILD, str(CPU_S), job, *(one for one in sys.path if isinstance(one, str))]
    limits = f"{CPU_S} s of CPU time and {MEMORY >> 30} GiB of memory to load it and run it once"
    try:
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_WAIT_S, check=False, text=True
        )
    except subprocess.TimeoutExpired:
        raise FileFormatError(f"{path} is refused: it did not load within {_WAIT_S:g} s") from None
    if ended.returncode == _REFUSED:
        kind = f"the weights of {tracker}" if tracker else "an ONNX file"
        raise FileFormatError(f"{path} can't be loaded as {kind}: {ended.stdout.strip()}")
    if ended.returncode != 0:
        last = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1][:300]
        why = f"signal {-ended.returncode}" if ended.returncode < 0 else last
        raise FileFormatError(f"{path} is refused: it takes more than {limits} ({why})")


def run_alone(cpu_s: int, tracker: str, *files: str) -> None:
    """Load a network and run it on zeros within limits. This runs as the main function of the child process."""
    if sys.platform != "win32":
        import resource

        memory = MEMORY + 4 * sum(Path(path).stat().st_size for path in files)
        for kind, most in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory)):
            _, allowed = resource.getrlimit(kind)  # a lower hard limit can't be raised
            limit = most if allowed == resource.RLIM_INFINITY else min(most, allowed)
            resource.setrlimit(kind, (limit, limit))
    try:
        run = _tracker(tracker, files) if tracker else _network(files[0])
    except Exception as error:  # noqa: BLE001 the parent raises it
        print(reason(error))
        sys.exit(_REFUSED)
    try:
        run()
    except Exception as error:
        # The shapes of the zeros are partly guessed, so only an error about memory says anything about the network.
        if isinstance(error, MemoryError) or "alloc" in str(error).lower():
            raise


def _network(path: str) -> Callable[[], object]:
    """Load a network and return a function that runs it on zeros."""
    import numpy as np
    import onnxruntime

    session = _session(onnxruntime, path, 1)
    kinds = {"tensor(float16)": np.float16, "tensor(uint8)": np.uint8, "tensor(int64)": np.int64}
    feed = {
        each.name: np.zeros(
            [side if isinstance(side, int) else 64 if number else 1 for number, side in enumerate(each.shape)],
            kinds.get(each.type, np.float32),
        )
        for each in session.get_inputs()
    }
    return lambda: session.run(None, feed)


def _tracker(name: str, files: Sequence[str]) -> Callable[[], object]:
    """Load a tracker's weights and return a function that tracks with them in a black image."""
    import numpy as np

    from skyloop.vision.opencv import opencv

    tracker, image = load_tracker(opencv("tracking"), name, files), np.zeros((240, 320, 3), np.uint8)
    return lambda: (tracker.init(image, (140, 100, 40, 40)), tracker.update(image))


def load_tracker(cv: Any, name: str, files: Sequence[str]) -> Any:
    """Create an OpenCV tracker by name and load its weights: one file for ViTTrack, two for NanoTrack."""
    settings = getattr(cv, f"{name}_Params")()
    if len(files) == 1:
        (settings.net,) = files
    else:
        settings.backbone, settings.neckhead = files
    return getattr(cv, f"{name}_create")(settings)


def reason(error: Exception) -> str:
    """Return an exception's text, shortened and on one line."""
    # Not error.err, which OpenCV keeps on the class, so that it holds the last error raised anywhere.
    return " ".join(str(error).split())[:300]
