"""Networks from ONNX files, run by ONNX Runtime on the processor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skyloop.errors import FileFormatError, MissingExtraError


def load_network(path: Path, threads: int, purpose: str) -> tuple[tuple[type[Exception], ...], Any]:
    """Load a network.

    Args:
        path: The ONNX file.
        threads: Of the processor for one run.
        purpose: What needs it; a noun phrase for the error message.

    Returns:
        The exceptions that running it raises, and ONNX Runtime's session.

    Raises:
        MissingExtraError: ONNX Runtime is not installed.
        FileFormatError: It is no ONNX file, or not one that ONNX Runtime takes.
    """
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as state
    except ImportError as error:
        raise MissingExtraError(purpose, "detect", cause=str(error)) from error
    own = [each for each in vars(state).values() if isinstance(each, type) and issubclass(each, Exception)]
    errors: tuple[type[Exception], ...] = (*own, RuntimeError, ValueError, TypeError)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # what is wrong is in the exception
    try:
        return errors, onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except errors as error:
        raise FileFormatError(f"{path} can't be loaded as an ONNX file: {reason(error)}") from error


def reason(error: Exception) -> str:
    """Return the text of an exception on one line, shortened."""
    return " ".join(str(error).split())[:300]
