"""Notice time stamps that repeat, that are in other units, and those of a clock that is off."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from imgcal.messages import list_names, round_to

LEAST_EXPOSURES = 30
"""Minimum number of exposures of a camera, most of which repeat a time stamp, or all of whose latest are left out."""
FASTEST_REPLAY = 300
"""Seconds by time stamps to a second of this machine's clock above which they must be in other units."""
LEAST_LEAPING = 10
"""Minimum number of snapshots, most of them after a jump, that show that time stamps are not in seconds."""


@dataclass
class TimeStampCheck:
    """Counts what is odd about the time stamps of exposures that do not belong to a named snapshot.

    Examples:
        >>> check = TimeStampCheck(("left", "right"))
        >>> for _ in range(40):
        ...     check.leave_out("right", ahead=2.5)
        >>> check.advise({"left": 40, "right": 40}, leaps=0)
        'left out: time stamps of right 2.5 s ahead: set the clock, or wait longer (--patience)'
    """

    camera_names: tuple[str, ...]
    left_out: Counter[str] = field(default_factory=Counter)  # latest exposures of a camera that came too late or early
    ahead: dict[str, float] = field(default_factory=dict)  # s, the last of these less the others' clock
    repeated: Counter[str] = field(default_factory=Counter)  # exposures whose time stamp the camera had sent before
    released: int = 0  # snapshots
    began: tuple[float, float] | None = None  # s: this machine's clock and the time stamp of the first exposure ...
    last: tuple[float, float] = (0.0, 0.0)  # ... and of the last one

    def take(self, camera: str, now: float, time: float, known: bool, repeats: bool) -> None:
        """Note an exposure.

        Args:
            camera: its name.
            now: s, this machine's clock.
            time: s, its time stamp.
            known: the camera has sent before since the clocks last jumped.
            repeats: its time stamp is one of the camera's latest.
        """
        self.last = now, time
        if self.began is None or not known:
            self.began = self.last
        self.repeated[camera] += repeats

    def leave_out(self, camera: str, ahead: float) -> None:
        """Note an exposure that cannot be used, and by how many seconds it is ahead of the others."""
        self.left_out[camera] += 1
        self.ahead[camera] = ahead

    def use(self, camera: str) -> None:
        """Note an exposure that belongs to a snapshot."""
        self.left_out[camera] = 0

    def advise(self, received: Mapping[str, int], leaps: int) -> str:
        """Say what is wrong, of all cameras or of some; empty = nothing that shows.

        Repeated exposures have repeated time stamps rightly, but hardly any source repeats most of them.

        Args:
            received: number of exposures by camera.
            leaps: number of joint jumps of all clocks.
        """
        names = self.camera_names
        repeating = [name for name in names if 2 * self.repeated[name] > received[name] >= LEAST_EXPOSURES]
        if repeating:
            return f"{list_names(repeating)}: most time stamps repeat an earlier one: give each exposure its own"
        passed, stamped = (last - first for first, last in zip(self.began or self.last, self.last, strict=True))
        if 2 * leaps > self.released >= LEAST_LEAPING or stamped > FASTEST_REPLAY * passed > 0:
            return "time stamps go on much faster than time passes: give them in seconds"
        off = {name: self.ahead[name] for name in names if self.left_out[name] >= LEAST_EXPOSURES}
        said = [f"{name} {round_to(abs(by), 2)} s {'ahead' if by > 0 else 'behind'}" for name, by in off.items()]
        what_to_do = "set the clock, or wait longer (--patience)"
        return f"left out: time stamps of {list_names(said)}: {what_to_do}" if said else ""
