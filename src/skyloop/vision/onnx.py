"""Networks from ONNX files, run by ONNX Runtime on the processor.

A file is a program of a stranger's: before it is loaded here, a child process loads and runs it within limits.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from skyloop.errors import FileFormatError, MissingExtraError

CPU_S: Final = 20  #: to load a network and to run it once
MEMORY: Final = 4 << 30  #: bytes of address space, beside four times the file's size
_WAIT_S: Final = 300.0  # on a busy computer
_REFUSED: Final = 3  # exit code of a child that says why
_OWN: Final = Path(__file__).with_name("weights")
#: Modules are looked up where this process does, and not in the working directory: strangers' files may lie there.
_CHILD: Final = (
    "import sys; sys.path[:] = sys.argv[3:]; "
    "from skyloop.vision.onnx import run_alone; run_alone(sys.argv[1], int(sys.argv[2]))"
)


def load_network(path: Path, threads: int, purpose: str) -> tuple[tuple[type[Exception], ...], Any]:
    """Load a network, once a child process has loaded it and run it on zeros within :data:`CPU_S` and :data:`MEMORY`.

    Args:
        path: The ONNX file.
        threads: Of the processor for one run.
        purpose: What needs it; a noun phrase for the error message.

    Returns:
        The exceptions that running it raises, and ONNX Runtime's session.

    Raises:
        MissingExtraError: ONNX Runtime is not installed.
        FileFormatError: It is no ONNX file, not one that ONNX Runtime takes, or it needs more than the limits.
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
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # what is wrong is in the exception
    try:
        return errors, onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except errors as error:
        raise FileFormatError(f"{path} can't be loaded as an ONNX file: {reason(error)}") from error


def try_alone(path: Path) -> None:
    """Load and run a network in a child process within limits.

    Raises:
        FileFormatError: It can't be loaded, or not within the limits.
    """
    command = [sys.executable, "-c", _CHILD, str(path), str(CPU_S), *(one for one in sys.path if isinstance(one, str))]
    limits = f"{CPU_S} s of the processor and {MEMORY >> 30} GiB of memory to load it and to run it once"
    try:
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_WAIT_S, check=False, text=True
        )
    except subprocess.TimeoutExpired:
        raise FileFormatError(f"{path} is refused: it was not ready within {_WAIT_S:g} s") from None
    if ended.returncode == _REFUSED:
        raise FileFormatError(f"{path} can't be loaded as an ONNX file: {ended.stdout.strip()}")
    if ended.returncode != 0:
        last = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1][:300]
        why = f"signal {-ended.returncode}" if ended.returncode < 0 else last
        raise FileFormatError(f"{path} is refused: it takes more than {limits} ({why})")


def run_alone(path: str, cpu_s: int) -> None:
    """Load a network and run it on zeros, within limits; the whole of a child process's life."""
    import numpy as np

    if sys.platform != "win32":
        import resource

        memory = MEMORY + 4 * Path(path).stat().st_size
        for kind, most in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory)):
            _, allowed = resource.getrlimit(kind)  # who is allowed less can't ask for more
            limit = most if allowed == resource.RLIM_INFINITY else min(most, allowed)
            resource.setrlimit(kind, (limit, limit))
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001  it is raised again where the network was asked for
        print(reason(error))
        sys.exit(_REFUSED)
    kinds = {"tensor(float16)": np.float16, "tensor(uint8)": np.uint8, "tensor(int64)": np.int64}
    feed = {
        each.name: np.zeros(
            [side if isinstance(side, int) else 64 if number else 1 for number, side in enumerate(each.shape)],
            kinds.get(each.type, np.float32),
        )
        for each in session.get_inputs()
    }
    try:
        session.run(None, feed)
    except Exception as error:
        if isinstance(error, MemoryError) or "alloc" in str(error).lower():
            raise


def reason(error: Exception) -> str:
    """Return the text of an exception on one line, shortened."""
    return " ".join(str(error).split())[:300]
