"""Outcomes of detectors on captures as tables, and in plain values for scripts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from statistics import fmean, median, stdev
from typing import Any

from imgcal.evaluation.detectors import WRONG_PX, WRONG_RATIO, Outcome, Scene
from imgcal.evaluation.tables import MISSING, Table, number

FORMAT = "imgcal-detectors/1"


def detector_tables(outcomes: Sequence[Outcome]) -> tuple[Table, ...]:
    """A line a detector, a column a difficulty: how often it calibrates, how well, in what time.

    Training seeds of one detector share its line: mean and standard deviation over them.
    """
    difficulties = list(dict.fromkeys(outcome.difficulty for outcome in outcomes))
    wrong = f"wrong: more than {WRONG_PX:g} px and {WRONG_RATIO:g} times what is claimed"
    parts: tuple[tuple[str, Callable[[Sequence[Outcome]], str]], ...] = (
        (f"Calibrated / refused / wrong, % of captures ({wrong})", _shares),
        ("Held-out RE (px): RMS over the working volume, median over calibrated captures", _held_out_cell),
        ("Labels that calibrations rest on: right, % / of all that is visible, %", _labels),
        ("Time a frame, median (ms), with identity and estimation", _milliseconds),
    )
    return tuple(
        Table(title, ("detector", "seeds", *difficulties), tuple(_rows(outcomes, difficulties, cell)))
        for title, cell in parts
    )


def _rows(
    outcomes: Sequence[Outcome], difficulties: Sequence[str], cell: Callable[[Sequence[Outcome]], str]
) -> list[tuple[str, ...]]:
    found = []
    for name in dict.fromkeys(outcome.contender for outcome in outcomes):
        ours = [outcome for outcome in outcomes if outcome.contender == name]
        cells = [[one for one in ours if one.difficulty == difficulty] for difficulty in difficulties]
        found.append((name, _seeds(ours), *(cell(some) if some else MISSING for some in cells)))
    return found


def _by_seed(outcomes: Sequence[Outcome]) -> list[list[Outcome]]:
    seeds = dict.fromkeys(outcome.training_seed for outcome in outcomes)
    return [[outcome for outcome in outcomes if outcome.training_seed == seed] for seed in seeds]


def _seeds(outcomes: Sequence[Outcome]) -> str:
    trained = {outcome.training_seed for outcome in outcomes} - {None}
    return MISSING if not trained else "one seed" if len(trained) == 1 else f"{len(trained)} seeds"


def _shares(outcomes: Sequence[Outcome]) -> str:
    found = []
    for status in ("calibrated", "refused", "wrong"):
        of_seeds = [100 * fmean(one.status == status for one in some) for some in _by_seed(outcomes)]
        spread = f" ± {stdev(of_seeds):.0f}" if len(of_seeds) > 1 else ""
        found.append(f"{fmean(of_seeds):.0f}{spread}")
    return " / ".join(found)


def _held_out_cell(outcomes: Sequence[Outcome]) -> str:
    of_seeds = [[one.held_out_px for one in some if one.status == "calibrated"] for some in _by_seed(outcomes)]
    medians = [median(value for value in some if value is not None) for some in of_seeds if some]
    return number(fmean(medians)) if medians else MISSING


def _labels(outcomes: Sequence[Outcome]) -> str:
    used = [one for one in outcomes if one.status != "refused"]
    labels = sum(one.labels for one in used)
    if not labels:
        return MISSING
    right = sum(one.right_labels for one in used)
    return f"{100 * right / labels:.1f} / {100 * right / sum(one.visible for one in used):.0f}"


def _milliseconds(outcomes: Sequence[Outcome]) -> str:
    return number(median(1e3 * one.seconds / one.frames for one in outcomes))


def detector_values(outcomes: Sequence[Outcome], scene: Scene, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that was found, capture by capture, and how often each reason was given."""
    reasons: dict[str, Counter[str]] = {}
    for outcome in outcomes:
        if outcome.status == "refused":
            reasons.setdefault(outcome.contender, Counter())[outcome.reason.partition(":")[0]] += 1
    return {
        "format": FORMAT,
        "rig": scene.rig.name,
        "object": scene.obj.name,
        "snapshots": scene.snapshots,
        "drift": {"kind": type(scene.drift).__name__} | vars(scene.drift),
        "difficulties": list(scene.models),
        **settings,
        "reasons": {name: dict(counted.most_common()) for name, counted in reasons.items()},
        "outcomes": [asdict(replace(outcome, reason=outcome.reason[:200])) for outcome in outcomes],
    }
