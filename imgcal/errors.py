"""The two ways in which a run can end without a result. Commands turn them into exit codes 2 and 3."""


class InputError(ValueError):
    """Raise for input that cannot be used; the message names the file, what was found and what was expected."""


class RefusedError(RuntimeError):
    """Raise when the input is sound but cannot decide the answer (identity unclear, too few fiducials, bad fit)."""
