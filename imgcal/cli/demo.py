"""`imgcal demo`: see it at work, without a rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from imgcal.cli.common import open_rig
from imgcal.errors import InputError
from imgcal.io import load_object
from imgcal.live_page import Demonstration, parse_address

MOST_RATE = 100.0


@dataclass(frozen=True)
class Demo:
    """See it at work: a simulated rig that is kept calibrated, on a page with buttons that bump and cover its cameras.

    Open the address that is printed. Ctrl+C ends it.
    Example: imgcal demo live
    """

    what: Annotated[Literal["live"], tyro.conf.Positional]  #: the live page
    rig: str = "O10"  #: rig: file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: str = "asymmetric8"  #: object: file, or the name of a shipped one
    serve: str | None = None  #: HOST:PORT to listen on; 127.0.0.1:8765, for this machine alone, where it is not given
    token: str | None = None  #: that others need who look on from elsewhere; a new one where it is not given
    rate: float = 15.0  #: snapshots a second

    def run(self) -> None:
        """Run until interrupted."""
        if not 0 < self.rate <= MOST_RATE:
            raise InputError(f"--rate: found {self.rate}, expected more than 0 and at most {MOST_RATE:g} a second")
        rig, obj = open_rig(self.rig), load_object(self.object)
        with Demonstration(rig, obj, parse_address(self.serve), self.token) as shown:
            print(shown.page.notice, flush=True)
            shown.run(self.rate)
