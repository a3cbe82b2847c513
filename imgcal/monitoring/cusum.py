"""Page's cumulative sum: the quickest test for an increased mean at a given false alarm rate.

Source: Page, "Continuous Inspection Schemes", 1954; Siegmund, "Sequential Analysis", 1985, equation 2.56.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

OVERSHOOT = 1.166
"""Average overshoot of a sum at its threshold, in standard deviations; it acts like a threshold that much higher."""


def cusum_threshold(reference: float, run_length: float) -> float:
    """Threshold (standard deviations) that is crossed once in `run_length` steps on average while the mean is normal.

    Args:
        reference: half of the increase (standard deviations) to be found most quickly.
        run_length: number of steps, each an independent normal value.

    Examples:
        >>> round(cusum_threshold(0.5, 336.0), 1)  # Montgomery, "Statistical Quality Control", has 4.0
        4.0
    """

    def excess(threshold: float) -> float:
        far = 2 * reference * (threshold + OVERSHOOT)
        return (math.expm1(far) - far) / (2 * reference**2) - run_length

    return float(brentq(excess, 0.0, 100.0 / reference))


class Cusum:
    """Cumulative sums of several values; each restarts at zero when it would become negative, and after an alarm.

    Examples:
        >>> test = Cusum(2, reference=0.5, run_length=1e6)
        >>> steps = [test.update((0.0, 3.0)).tolist() for _ in range(6)]
        >>> steps[3:], test.age.tolist()
        ([[False, False], [False, True], [False, False]], [0, 1])
    """

    STATE: ClassVar = {
        "value": ("value", NDArray[np.float64]),
        "age": ("age", NDArray[np.int64]),
        "found": ("found", NDArray[np.int64]),
    }

    def __init__(self, count: int, reference: float, run_length: float) -> None:
        """Start at zero; see `cusum_threshold`."""
        self.reference, self.threshold = reference, cusum_threshold(reference, run_length)
        self.value = np.zeros(count)
        self.age = np.zeros(count, dtype=np.int64)  # steps since the sum was zero: how long the mean has been high
        self.found = np.zeros(count, dtype=np.int64)  # the same at the last alarm of each

    def update(self, standardized: ArrayLike) -> NDArray[np.bool_]:
        """Add a step (count,), in standard deviations from the mean, nan = no value; return which means increased."""
        step = np.asarray(standardized, dtype=np.float64) - self.reference
        step[np.isnan(step)] = 0.0
        self.value = np.maximum(self.value + step, 0.0)
        self.age = np.where(self.value > 0, self.age + 1, 0)
        risen: NDArray[np.bool_] = self.value > self.threshold
        self.found = np.where(risen, self.age, self.found)
        self.value, self.age = np.where(risen, 0.0, self.value), np.where(risen, 0, self.age)
        return risen


class RunningMedian:
    """Median of the most recent numbers.

    Examples:
        >>> median = RunningMedian(3)
        >>> for number in (9.0, 1.0, 4.0, 5.0):
        ...     median.append(number)
        >>> median.value  # of 1, 4 and 5
        4.0
    """

    STATE: ClassVar = {"latest": ("_latest", deque[float])}

    def __init__(self, most: int) -> None:
        """Start empty, and keep at most `most` numbers."""
        self._latest, self._sorted = deque[float](maxlen=most), list[float]()

    def __len__(self) -> int:
        return len(self._latest)

    def resume(self) -> None:
        """Sort the numbers after a state has been read."""
        self._sorted = sorted(self._latest)

    def append(self, number: float) -> None:
        """Add a number, and drop the oldest if there are too many."""
        if len(self._latest) == self._latest.maxlen:
            del self._sorted[bisect.bisect_left(self._sorted, self._latest[0])]
        self._latest.append(number)
        bisect.insort(self._sorted, number)

    @property
    def value(self) -> float:
        """The median; nan if empty."""
        count = len(self._sorted)
        return 0.5 * (self._sorted[(count - 1) // 2] + self._sorted[count // 2]) if count else math.nan
