"""Process one capture of a fleet: fetch it, recalibrate it as `imgcal calibrate` does, and return a row in any case."""

from __future__ import annotations

import contextlib
import datetime
import gzip
import hashlib
import json
import os
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import torch

import imgcal
from imgcal.association import PipelineOptions
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import camera_covariance, whitened_covariance
from imgcal.fleet.drift_information import parameter_units
from imgcal.fleet.manifest import Item, open_file, short_reason
from imgcal.formats import Source, load_rig
from imgcal.io import Capture, is_shipped, load_object, open_input, rig_text
from imgcal.messages import one_line
from imgcal.pipeline import Calibration, Detector, DetectorName, calibrate, capture_sight, detect_capture
from imgcal.types import CalibrationObject, CameraRig

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

Status = Literal["ok", "refused", "unusable", "unreachable", "timed_out", "out_of_memory", "crashed", "fault"]
"""What became of a capture. `unusable`: its files are wrong; `unreachable`: not to be read; `fault`: one of imgcal."""
TRANSIENT = frozenset({"unreachable", "timed_out", "out_of_memory", "crashed"})
"""What another try may mend."""
BLOCK = 1 << 20
REMINDER = 5.0
"""Seconds until code that could not be interrupted, a callback for example, is interrupted again."""
STATM = Path("/proc/self/statm")  # Linux tells there how much memory a process has


@dataclass(frozen=True)
class Settings:
    """Settings for every capture."""

    blind_cameras: bool = False
    detector: DetectorName = "classical"
    seconds: float = 300.0  # that a capture may take
    memory_mb: float = 4096.0  # that it may take beyond what the process has already
    keep_rig: bool = False  # the text of its rig file, too

    def key(self) -> str:
        """The settings that results depend on, as text."""
        decides = {"blind_cameras": self.blind_cameras, "detector": self.detector, "version": imgcal.__version__}
        return json.dumps(decides, sort_keys=True)


class TooLongError(BaseException):
    """The time limit of a capture is over. Only `process` catches it."""


def item_id(item: Item) -> str:
    """Identify a row of the manifest by its cells, whatever its files hold: 32 hexadecimal digits."""
    said = json.dumps([item.capture, item.rig, item.object, item.device, item.time, item.given])
    return hashlib.blake2b(said.encode(), digest_size=16).hexdigest()


def process(item: Item, settings: Settings, known: frozenset[str] | Any = frozenset()) -> dict[str, Any] | None:
    """Recalibrate one capture.

    Args:
        item: what to fetch.
        settings: how to treat it.
        known: keys that need not be done again.

    Returns:
        A row of the results; None where its key is known. Never raises for what is wrong with a capture.
    """
    started, spent = time.perf_counter(), time.process_time()
    row = _capture_row(item)
    status, extra = "ok", dict[str, Any]()
    try:
        if item.fault:
            raise InputError(item.fault)
        with tempfile.TemporaryDirectory(prefix="imgcal-fleet-") as folder, _limit(settings):
            path = fetch(item.capture, Path(folder))
            row["key"] = content_key(path, item, settings)
            if row["key"] in known:
                return None
            extra = _recalibrate(path, *_load_rig_and_object(item.rig, item.object), settings)
    except RefusedError as error:
        status, row["reason"] = "refused", one_line(error.reason)
    except InputError as error:
        status, row["reason"] = "unusable", one_line(str(error))
    except _Unreachable as error:
        status, row["reason"] = "unreachable", one_line(str(error))
    except TooLongError:
        status, row["reason"] = "timed_out", f"took longer than {settings.seconds:g} s"
    except Exception as error:
        status, row["reason"] = _fault(error, settings)
    took = {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - spent}
    return row | {"status": status} | took | extra


def failed_row(item: Item, status: Status, reason: str) -> dict[str, Any]:
    """Row of a capture whose process died."""
    return _capture_row(item) | {"status": status, "reason": reason, "seconds": 0.0, "cpu_seconds": 0.0}


def current_key(item: Item, settings: Settings) -> str:
    """Digest of what a result of this row depends on now; empty where its files cannot be read."""
    with contextlib.suppress(InputError, _Unreachable), tempfile.TemporaryDirectory(prefix="imgcal-fleet-") as folder:
        return content_key(fetch(item.capture, Path(folder)), item, settings)
    return ""


def _capture_row(item: Item) -> dict[str, Any]:
    """The columns of a capture that do not depend on the outcome."""
    moment = None if item.time is None else datetime.datetime.fromtimestamp(item.time, datetime.UTC)
    return {
        "item": item_id(item), "key": "", "device": item.device, "time": moment, "capture": item.capture,
        "rig": item.rig, "object": item.object, "given": list(item.given), "reason": "",
    }  # fmt: skip


class _Unreachable(Exception):
    """A file that could not be fetched: a network failure, or a wrong path."""


def fetch(url: str, folder: Path) -> Path:
    """Bring a capture to this machine; a local one stays where it is.

    Raises:
        InputError: a local path that is not there.
        _Unreachable: anything else that stands between.
    """
    if "://" not in url:
        _stat(url, "a capture folder or a detections file", folder=True)
        return Path(url)
    import fsspec

    try:
        system, path = fsspec.core.url_to_fs(url)
        name = path.rstrip("/").rsplit("/", 1)[-1]
        system.get(path.rstrip("/"), str(folder / name), recursive=system.isdir(path))
    except Exception as error:
        raise _Unreachable(f"{url}: cannot be read: {short_reason(error)}") from error
    return folder / name


def content_key(path: Path, item: Item, settings: Settings) -> str:
    """Digest of everything that a result depends on: 32 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(f"{settings.key()}\n{item_id(item)}\n".encode())
    for url in (item.rig, item.object):
        digest.update(_read_content(url))
    try:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            digest.update(f"{file.relative_to(path)}\n".encode(errors="surrogateescape"))
            with open(file, "rb") as stream:
                while block := stream.read(BLOCK):
                    digest.update(block)
    except OSError as error:
        raise InputError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    return digest.hexdigest()


def _read_content(url: str) -> bytes:
    """Bytes of all files that a rig or an object is read from; the name itself of a shipped one."""
    if is_shipped(url):
        return url.encode()
    if "://" in url:
        return _small_file(url, str(int(time.time()) // 60))  # asked for again every minute
    _stat(url, "a file or the folder of a calibration", folder=True)
    return b"".join(_small_file(str(path), _stamp(path)) for path in Source([Path(url)]).files)


def _stamp(path: Path) -> str:
    """A value that changes when a file does, without reading it."""
    found = _stat(str(path), "a file")
    return f"{found.st_mtime_ns} {found.st_size} {found.st_ino}"


def _stat(path: str, expected: str, *, folder: bool = False) -> os.stat_result:
    """Check for a file or folder: reading a device or a pipe may block forever.

    Raises:
        InputError: there is none, or it is something else.
    """
    try:
        found = Path(path).stat()
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {short_reason(error)}") from error
    if not (stat.S_ISREG(found.st_mode) or (folder and stat.S_ISDIR(found.st_mode))):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or pipe"
        raise InputError(f"{path}: found {kind}, expected {expected}")
    return found


@lru_cache(maxsize=256)
def _small_file(url: str, stamp: str) -> bytes:
    with open_file(url) as file:
        return bytes(file.read())


def _load_rig_and_object(rig: str, obj: str) -> tuple[CameraRig, CalibrationObject]:
    return _load(rig, _read_content(rig), "rig"), _load(obj, _read_content(obj), "object")


@lru_cache(maxsize=256)
def _load(url: str, content: bytes, kind: Literal["rig", "object"]) -> Any:
    load = load_rig if kind == "rig" else load_object
    if "://" not in url:
        return load(url)
    with tempfile.TemporaryDirectory(prefix="imgcal-fleet-") as folder:
        path = Path(folder) / url.rsplit("/", 1)[-1]
        path.write_bytes(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)
        return load(str(path))


def _recalibrate(path: Path, rig: CameraRig, obj: CalibrationObject, settings: Settings) -> dict[str, Any]:
    """The columns of a capture that was recalibrated."""
    source = open_input(path, rig, obj.rows)
    detector: Detector = "classical"
    if isinstance(source, Capture):
        if settings.detector != "classical":
            detector = capture_sight(source, settings.detector)
        source, _ = detect_capture(source, board=obj.board)
    options = PipelineOptions(blind_cameras=settings.blind_cameras)
    result = calibrate(source, rig, obj, options, detector=detector)
    return result_columns(result) | ({"rig_file": rig_text(result.rig)} if settings.keep_rig else {})


def result_columns(result: Calibration) -> dict[str, Any]:
    """The columns of a calibration; `information_factor` is R of R^T R = 1 + information / prior, row by row."""
    estimate, solution = result.estimate, result.estimate.solution
    whitened = torch.linalg.inv(whitened_covariance(solution))[0]
    factor = torch.linalg.cholesky(0.5 * (whitened + whitened.mT), upper=True)
    upper = torch.triu_indices(*factor.shape)
    offset, cameras = result.rig.local(result.factory), result.rig.num_cameras
    return {
        "cameras": list(result.rig.camera_names),
        "lenses": list(result.rig.lens_models),
        "parameters": [name for camera in range(cameras) for name in result.rig.parameter_names_of(camera)],
        "identity": result.identity,
        "offset": offset.flatten().tolist(),
        "std": camera_covariance(estimate, curved=False).diagonal().clamp_min(0).sqrt().tolist(),
        "prior_std": estimate.problem.prior_std.flatten().tolist(),
        "unit": parameter_units(result.factory).flatten().tolist(),
        "whitened_offset": solution.state.offset.flatten().tolist(),
        # Thousands: no list of Python's. In double precision, without which directions that images do not show
        # seem to have negative information.
        "information_factor": factor[upper[0], upper[1]].numpy(),
        "inflation": estimate.mean_inflation,
        "rms_px": float(result.rms),
        "chi2_per_dof": float(result.chi2_per_dof),
        "snapshots": result.labelled.moment_counts[0],
        "labels": int(result.observations.seen.sum()),
        "outliers": result.outliers,
        "moved": [str(move) for move in result.moved],
    }


def _fault(error: Exception, settings: Settings) -> tuple[Status, str]:
    text = one_line(f"{type(error).__name__}: {error}")
    memory = isinstance(error, MemoryError) or any(
        words in text for words in ("not enough memory", "allocate memory", "Insufficient memory", "bad_alloc")
    )
    if memory:
        return "out_of_memory", f"needed more than {settings.memory_mb:g} MB"
    return "fault", text


@contextlib.contextmanager
def _limit(settings: Settings) -> Iterator[None]:
    """Limit the time (not on Windows) and the memory (on Linux) of the block."""

    def over(number: int, frame: FrameType | None) -> None:
        raise TooLongError

    timed = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    pages = int(STATM.read_text().split()[0]) if resource is not None and STATM.exists() else 0
    before = resource.getrlimit(resource.RLIMIT_AS) if pages else None
    old = None
    try:
        if timed:
            old = signal.signal(signal.SIGALRM, over)
            signal.setitimer(signal.ITIMER_REAL, settings.seconds, REMINDER)
        if before is not None:
            limit = pages * resource.getpagesize() + int(settings.memory_mb * 2**20)
            resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
        yield
    finally:
        if before is not None:
            resource.setrlimit(resource.RLIMIT_AS, before)
        if timed:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, old)
