"""Optional dependencies: which extra installs which library."""

from __future__ import annotations

from importlib.util import find_spec

EXTRAS = {
    "fleet": ("filelock", "fsspec", "pyarrow", "ray"),
    "train": ("accelerate", "tensorboard", "timm"),
    "watch": ("prometheus_client", "zmq", "rosbags"),
    "report": ("jinja2", "matplotlib"),
    "live": ("uvicorn",),
    "onnx": ("onnx", "onnxruntime"),
    "lsl": ("pylsl",),
}
"""Libraries of each extra, by import name; `pyproject.toml` has the versions."""


def missing(*libraries: str) -> str | None:
    """Name the first of the given libraries that is not installed, None if all are. Nothing is imported.

    Examples:
        >>> missing("json", "a_library_that_nobody_has")
        'a_library_that_nobody_has'
    """
    return next((library for library in libraries if find_spec(library) is None), None)


def advice(library: str | None) -> str | None:
    """Say what to install for a library of an extra; None for any other library.

    Examples:
        >>> advice("timm")
        'needs timm: pip install ".[train]" in the clone'
    """
    for extra, libraries in EXTRAS.items():
        if library in libraries:
            return f'needs {library}: pip install ".[{extra}]" in the clone'
    return None
