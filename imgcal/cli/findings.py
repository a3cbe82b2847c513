"""What a calibration says beside its errors: which cameras have moved, what is not known, and where to go next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from imgcal.estimation import Gauge
from imgcal.io import RigCovariance
from imgcal.messages import list_names
from imgcal.pipeline import Calibration, Coverage, Motion, measure_coverage, motion_since_factory
from imgcal.types import MovedCamera


@dataclass(frozen=True)
class Findings:
    """The same for the printed lines, for result.json and for the report."""

    motion: Motion
    knowledge: Coverage
    from_scratch: bool = False  # there was no factory calibration since which a camera could have moved
    moved: tuple[MovedCamera, ...] = ()  # during the capture
    untimed: tuple[str, ...] = ()  # cameras of which nothing tells whether their frames are of the same moments

    @property
    def values(self) -> dict[str, Any]:
        """The form that scripts read."""
        motion, known = self.motion, self.knowledge
        reference = motion.gauge.reference
        since_factory = () if self.from_scratch else motion.moves
        return {
            "moved": [move.as_values() for move in (*since_factory, *self.moved)],
            "motion": None
            if self.from_scratch
            else {
                "relative_to": "most cameras" if reference is None else motion.camera_names[reference],
                "cameras_moved": [motion.camera_names[c] for c in motion.moved],
                "per_camera": {
                    name: {"rotation_deg": float(motion.rotation_deg[c]), "position_mm": float(motion.position_mm[c])}
                    for c, name in enumerate(motion.camera_names)
                },
            },
            "timing_untested": list(self.untimed),
            "knowledge": {
                "coverage": dict(zip(known.camera_names, known.coverage, strict=True)),
                "undetermined": {name: list(cameras) for name, cameras in known.undetermined.items()},
                "move_object_to_mm": [list(place.rig_from_centre) for place in known.places],
            },
        }

    @property
    def lines(self) -> list[str]:
        """What is printed."""
        lines = [self.motion.sentence] if self.motion.sentence and not self.from_scratch else []
        if self.knowledge.sentences:
            lines.append("not known: " + " ".join(self.knowledge.sentences))
        if self.untimed:
            which = "all cameras" if len(self.untimed) == len(self.knowledge.camera_names) else list_names(self.untimed)
            lines.append(
                f"timing of {which} not tested: the object moved too little, or too evenly, between snapshots to show "
                "a camera that is late"
            )
        if self.knowledge.advice:
            lines.append(self.knowledge.advice)
        return lines


UNKNOWN: dict[str, Any] = {"motion": None, "timing_untested": None, "knowledge": None}
"""`Findings.values` of a refused run."""


def findings(calibration: Calibration, gauge: Gauge, covariance: RigCovariance) -> Findings:
    """Look at what was found."""
    motion, knowledge = motion_since_factory(calibration, gauge), measure_coverage(calibration, covariance.std)
    return Findings(motion, knowledge, calibration.from_scratch, calibration.moved, calibration.untimed)
