"""A simulated rig behind the page, with buttons for what happens to real ones."""

from __future__ import annotations

import contextlib
import threading
import time

import torch

from imgcal.errors import RefusedError
from imgcal.live_page.address import Address
from imgcal.live_page.commands import Action, Command
from imgcal.live_page.live_page import LivePage
from imgcal.live_page.rig_drawing import viewing_volume
from imgcal.online import RigKeeper, RigState
from imgcal.synthesis import PhysicalDrift, SimulatedRig
from imgcal.types import CalibrationObject, CameraRig

ACTIONS = (
    Action("bump", "Bump it", of_camera=True),
    Action("cover", "Cover it", of_camera=True),
    Action("uncover", "Uncover all"),
    Action("warm", "Warm the lenses up", undo="Let the lenses cool down"),
    Action("away", "Take the object away", undo="Bring the object back"),
)
AGED = PhysicalDrift(rotation_deg=0.01, position=0.1, focal_length=2e-4, principal_point=0.3, distortion=2e-4)
"""How a rig differs from its factory calibration on a good day."""
BUMP_DEG = 0.3
SETTLED = 20
"""Snapshots learned before a camera is bumped. With fewer, the filter can report the move but not its kind."""
PICTURE_WIDTH = 320  # pixels
PICTURE_SECONDS = 0.5


class Demonstration:
    """A rig that runs by itself, is kept calibrated, and is shown. A context manager.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> with Demonstration(rig, obj, Address(port=0)) as shown:
        ...     state = shown.step(0.0)
        >>> state.cameras["cam01"]
        'ok'
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        address: Address = Address(),
        token: str | None = None,
        seed: int = 0,
    ) -> None:
        """Open the address.

        Args:
            rig: the factory calibration.
            obj: the calibration object.
            address: where to listen.
            token: see `LivePage`.
            seed: of all that is random.

        Raises:
            InputError: the address is taken.
        """
        rig = rig.to(torch.float64)
        volume = viewing_volume(rig)
        true = AGED.apply(rig, torch.Generator().manual_seed(seed))
        self.simulated = SimulatedRig(true, obj, volume.low, volume.high, seed)
        self.page = LivePage(rig, obj, address, token=token, actions=ACTIONS, title="imgcal demo")
        self.keeper = RigKeeper(rig, obj)
        self.paused = False
        self._learnt, self._bumps = 0, list[str]()  # snapshots, and cameras that are to be bumped
        self._drawn = -1.0

    def __enter__(self) -> Demonstration:
        """Return itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the server and the keeper's threads."""
        self.page.close()
        self.keeper.__exit__(None, None, None)

    def run(self, rate: float, ended: threading.Event | None = None) -> None:
        """Take `rate` snapshots a second, or as many as the machine can, until stopped."""
        ended = ended or threading.Event()
        begun, count = time.monotonic(), 0
        while not ended.wait(max(0.0, begun + count / rate - time.monotonic())):
            self.step(time.monotonic() - begun)
            count = max(count + 1, int((time.monotonic() - begun) * rate))  # what is late is left out

    def step(self, seconds: float) -> RigState | None:
        """Run the commands that are waiting, and take a snapshot; None while paused."""
        for command in self.page.commands():
            self._apply_command(command)
        if self._learnt >= SETTLED:
            for name in self._bumps:
                self.simulated.bump(self.simulated.rig.camera_names.index(name), BUMP_DEG)
            self._bumps.clear()
        blobs = self.simulated.snapshot(seconds)
        if self.paused:
            return None
        state = self.keeper.update(blobs, time.time())
        self._learnt += state.refused is None
        due = seconds - self._drawn >= PICTURE_SECONDS or self._drawn < 0
        self._drawn = seconds if due else self._drawn
        self.page.publish(state, self.simulated.frames(PICTURE_WIDTH) if due else None)
        return state

    def _apply_command(self, command: Command) -> None:
        names = list(self.simulated.rig.camera_names)
        match command.name, command.camera:
            case "bump", str(name):
                self._bumps.append(name)
            case "cover", str(name):
                self.simulated.covered.add(names.index(name))
            case "uncover", _:
                self.simulated.covered.clear()
            case "warm", _:
                self.simulated.warm = not self.simulated.warm
            case "away", _:
                self.simulated.away = not self.simulated.away
            case "pause" | "resume", _:
                self.paused = command.name == "pause"
            case "factory", _:
                with contextlib.suppress(RefusedError):  # before the first snapshot it is the factory's
                    self.page.tell(self.keeper.accept_as_factory())
