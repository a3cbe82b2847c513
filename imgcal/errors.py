"""The two ways in which a run can end without a result. Commands turn them into exit codes 2 and 3."""

from __future__ import annotations


class InputError(ValueError):
    """Raise for input that cannot be used; the message names the file, what was found and what was expected."""


class RefusedError(RuntimeError):
    """Raise when the input is sound but cannot decide the answer (identity unclear, too few fiducials, bad fit).

    What helps has one wording for Python, which is part of the message, and one for the command line.
    """

    def __init__(self, reason: str, *, python: str = "", command: str = "") -> None:
        """Keep the reason, and what to do about it in either interface.

        Args:
            reason: what was found and what was expected.
            python: what a caller can do.
            command: the same for somebody who types `imgcal ...`.
        """
        super().__init__(f"{reason}; {python}" if python else reason)
        self.reason = reason
        self.for_command = f"{reason}; {command}" if command else reason
