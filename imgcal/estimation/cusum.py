"""Page's cumulative sum: the quickest test for a mean that has risen, with a stated rate of false alarms.

Source: Page, "Continuous Inspection Schemes", 1954; Siegmund, "Sequential Analysis", 1985, equation 2.56.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

OVERSHOOT = 1.166
"""Standard deviations by which a sum passes its threshold, as if that were so much higher."""


def cusum_threshold(reference: float, run_length: float) -> float:
    """Threshold (standard deviations) that is passed once in `run_length` steps on average while nothing rises.

    Args:
        reference: half of the rise (standard deviations) that is to be found most quickly.
        run_length: steps of independent normal values.

    Examples:
        >>> round(cusum_threshold(0.5, 336.0), 1)  # Montgomery, "Statistical Quality Control", has 4.0
        4.0
    """

    def excess(threshold: float) -> float:
        far = 2 * reference * (threshold + OVERSHOOT)
        return (math.expm1(far) - far) / (2 * reference**2) - run_length

    return float(brentq(excess, 0.0, 100.0 / reference))


class Cusum:
    """Sums of several values; each is zero again where it would fall below, and after an alarm.

    Examples:
        >>> test = Cusum(2, reference=0.5, run_length=1e6)
        >>> steps = [test.update((0.0, 3.0)).tolist() for _ in range(6)]
        >>> steps[3:], test.age.tolist()
        ([[False, False], [False, True], [False, False]], [0, 1])
    """

    def __init__(self, count: int, reference: float, run_length: float) -> None:
        """Begin with zero; see `cusum_threshold`."""
        self.reference, self.threshold = reference, cusum_threshold(reference, run_length)
        self.value = np.zeros(count)
        self.age = np.zeros(count, dtype=np.int64)  # steps since the sum was zero: since when the mean has risen
        self.found = np.zeros(count, dtype=np.int64)  # the same of the last alarm of each

    def update(self, standardized: ArrayLike) -> NDArray[np.bool_]:
        """Add a step, in standard deviations from the mean; nan where there is none. Tell which have risen."""
        step = np.nan_to_num(np.asarray(standardized, dtype=np.float64) - self.reference, nan=0.0)
        self.value = np.maximum(self.value + step, 0.0)
        self.age = np.where(self.value > 0, self.age + 1, 0)
        risen: NDArray[np.bool_] = self.value > self.threshold
        self.found = np.where(risen, self.age, self.found)
        self.value, self.age = np.where(risen, 0.0, self.value), np.where(risen, 0, self.age)
        return risen
