"""Exceptions for the two ways a run can end without a result. Commands turn them into exit codes 2 and 3."""

from __future__ import annotations


class InputError(ValueError):
    """Raise for input that cannot be used; the message names the file, what was found and what was expected.

    Examples:
        >>> import imgcal
        >>> try:
        ...     imgcal.load_rig("O11")
        ... except imgcal.InputError as error:
        ...     print(error)
        O11: ...
    """


class RefusedError(RuntimeError):
    """Raise when the input is valid but does not determine the answer (identity unclear, too few fiducials, bad fit).

    The advice has two wordings: one for Python, which is part of the message, and one for the command line.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> seen = true_detections(simulate_truth(rig, obj, 1, torch.Generator().manual_seed(0), None))
        >>> try:
        ...     imgcal.calibrate(seen.select(seen.fiducial < 3), rig, obj)  # three fiducials are too few
        ... except imgcal.RefusedError as error:
        ...     print(error)
        identity...
    """

    def __init__(self, reason: str, *, python: str = "", command: str = "") -> None:
        """Store the reason and the advice for both interfaces.

        Args:
            reason: what was found and what was expected.
            python: advice for callers from Python.
            command: advice for users of the `imgcal` command.
        """
        super().__init__(f"{reason}; {python}" if python else reason)
        self.reason = reason
        self.for_command = f"{reason}; {command}" if command else reason

    def append(self, finding: str) -> None:
        """Add a finding that may be the cause to all wordings."""
        self.args = (f"{self}; {finding}",)
        self.reason, self.for_command = f"{self.reason}; {finding}", f"{self.for_command}; {finding}"
