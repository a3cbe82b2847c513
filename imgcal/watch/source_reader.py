"""Reads a source in its own thread, with a short queue of snapshots."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter, deque

from imgcal.errors import InputError
from imgcal.messages import one_line
from imgcal.types import CameraRig
from imgcal.watch.earlier_run import Known
from imgcal.watch.exposures import CameraBlobs, Exposure, Item, Source, Unreadable, check_exposure
from imgcal.watch.synchronization import Synchronizer, TimedSnapshot
from imgcal.watch.timing import Timing

MOST_WAITING = 8
"""Maximum length of the queue; beyond it, a live source drops the oldest snapshot, any other source waits."""
MOST_BYTES = 2**30
"""Maximum memory (bytes) of the queued frames; beyond it, the same happens."""
LATELY = 3  # number of reasons to keep
WOKEN = 0.2  # s
LONGEST_OPENING = 10.0  # s


class SourceReader:
    """Snapshots of a source, in order of completion. A context manager: leaving it stops the thread.

    Unreadable data are counted and skipped; an error that ends the source is raised by `next`.
    """

    def __init__(
        self,
        source: Source,
        rig: CameraRig,
        timing: Timing = Timing(),
        keep_all: bool = False,
        waiting: int = MOST_WAITING,
        known: Known | None = None,
    ) -> None:
        """Prepare to read.

        Args:
            source: source of exposures.
            rig: to check exposures against.
            timing: when exposures belong together.
            keep_all: drop nothing, even if the source is live: treat it as a recording.
            waiting: maximum length of the queue.
            known: how much of this recording an earlier run has processed; None = nothing.
        """
        self.synchronizer = Synchronizer(rig.camera_names, timing)
        self.dropped = 0
        """Number of complete snapshots that were dropped."""
        self.unreadable: Counter[str] = Counter()
        """Number of unreadable items by camera; "" = unknown."""
        self.reasons: deque[str] = deque(maxlen=LATELY)
        """Why the latest ones could not be read."""
        self.known_before = 0
        """Number of a recording's snapshots that an earlier run has processed."""
        self.first: int | None = None
        """Digest of the first snapshot of the source that shows anything; None = nothing yet."""
        self.resumes = known is not None and known.is_same
        """Whether this surely is the recording of which an earlier run has processed a part."""
        self._source, self._rig, self._most, self._keep_all = source, rig, waiting, keep_all
        self._known = known
        self._snapshots: deque[TimedSnapshot] = deque()
        self._bytes = 0
        self._blobs: bool | None = None  # True = blobs, False = frames, None = nothing yet
        self._changed = threading.Condition()
        self._closing = self._ended = self._begun = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="intake", daemon=True)  # a read may hang in a driver

    def __enter__(self) -> SourceReader:
        """Start reading."""
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """End reading."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout=2.0)

    @property
    def live(self) -> bool:
        """Whether snapshots are dropped if they are not processed in time."""
        return self._source.live and not self._keep_all

    @property
    def waiting(self) -> int:
        """Number of snapshots in the queue."""
        return len(self._snapshots)

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        with self._changed:
            return self._ended and not self._snapshots

    def wait_until_open(self) -> SourceReader:
        """Wait until the source has been opened, at most `LONGEST_OPENING` seconds; return `self`.

        If an earlier run has processed a part of a recording, also wait until it is clear whether this is that one.

        Raises:
            InputError: the source cannot be opened, or not be resumed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ended or (self._begun and self._is_known()), LONGEST_OPENING)
            if self._error is not None and not (self._begun and self._is_known()):
                raise self._error
        return self

    def _is_known(self) -> bool:
        """Tell whether it is clear how much of the source is known."""
        return self._known is None or self._known.is_same

    def next(self, timeout: float) -> TimedSnapshot | None:
        """Take the oldest snapshot from the queue; None = none came within `timeout` seconds.

        Raises:
            InputError: the source cannot continue; all earlier snapshots have been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._snapshots or self._ended, timeout)
            if self._snapshots:
                snapshot = self._snapshots.popleft()
                self._bytes -= snapshot.num_bytes
                self._changed.notify_all()
                return snapshot
            if self._error is not None:
                raise self._error
            return None

    def _read(self) -> None:
        items = self._source.items()
        try:
            with contextlib.closing(items):  # type: ignore[type-var]  # a generator
                for item in items:
                    if self._closing:
                        return
                    if not self._begun:
                        with self._changed:
                            self._begun = True
                            self._changed.notify_all()
                    self._take(item)
            for snapshot in self.synchronizer.flush():
                self._put(snapshot)
        except BaseException as error:
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _take(self, item: Item) -> None:
        now = time.monotonic() if self.live else 0.0
        if isinstance(item, Exposure):
            try:
                done = self.synchronizer.add(self._check_kind(check_exposure(item, self._rig)), now)
            except InputError as error:
                known = item.camera if item.camera in self._rig.camera_names else ""
                self._note(Unreadable(str(error), known))
                return
        else:
            if item is not None:
                self._note(item)
            done = self.synchronizer.release_due(now)
        for snapshot in done:
            self._put(snapshot)

    def _check_kind(self, exposure: Exposure) -> Exposure:
        """Compare an exposure's kind with that of the first one.

        Raises:
            InputError: a frame among blobs, or blobs among frames: a mixture is not supported.
        """
        blobs = isinstance(exposure.content, CameraBlobs)
        self._blobs = blobs if self._blobs is None else self._blobs
        if blobs != self._blobs:
            found, expected = ("blobs", "a frame") if blobs else ("a frame", "blobs")
            raise InputError(f"{exposure.camera}: found {found}, expected {expected} as in the first exposure")
        return exposure

    def _note(self, item: Unreadable) -> None:
        self.unreadable[item.camera or ""] += 1
        self.reasons.append(one_line(item.reason))

    def _put(self, snapshot: TimedSnapshot) -> None:
        if self._is_included(snapshot):
            return
        with self._changed:
            while self._is_full(snapshot) and not self._closing:
                if self.live:
                    self._bytes -= self._snapshots.popleft().num_bytes
                    self.dropped += 1
                else:
                    self._changed.wait(WOKEN)
            self._snapshots.append(snapshot)
            self._bytes += snapshot.num_bytes
            self._changed.notify_all()

    def _is_included(self, snapshot: TimedSnapshot) -> bool:
        """Tell whether an earlier run has processed a snapshot.

        Raises:
            InputError: the source cannot be resumed.
        """
        with self._changed:
            if self.first is None and (digest := snapshot.digest) is not None:
                self.first = digest
                self._known = None if self._known is None else self._known.compare(digest)
                self.resumes = self._known is not None and self._known.is_same
            if self._known is None:
                return False
            included = self._known.includes(snapshot)
            self.known_before += included
            if not included or self._known.ends_with(snapshot):
                self._known = None  # everything from now on is new
            self._changed.notify_all()
            return included

    def _is_full(self, snapshot: TimedSnapshot) -> bool:
        """Tell whether the queue has no room for a snapshot; an empty one has."""
        full = len(self._snapshots) >= self._most or self._bytes + snapshot.num_bytes > MOST_BYTES
        return full and len(self._snapshots) > 0
