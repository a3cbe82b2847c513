"""`imgcal demo`: see it at work, without a rig."""

from __future__ import annotations

from imgcal.cli import arguments
from imgcal.cli.common import open_rig
from imgcal.errors import InputError
from imgcal.io import load_object
from imgcal.live_page import Demonstration, parse_address

MOST_RATE = 100.0


class Demo(arguments.Demo):
    """Run `imgcal demo`."""

    def run(self) -> None:
        """Run until interrupted."""
        if not 0 < self.rate <= MOST_RATE:
            raise InputError(f"--rate: found {self.rate}, expected more than 0 and at most {MOST_RATE:g} a second")
        rig, obj = open_rig(self.rig), load_object(self.object)
        with Demonstration(rig, obj, parse_address(self.serve), self.token) as shown:
            print(shown.page.notice, flush=True)
            shown.run(self.rate)
