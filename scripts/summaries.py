"""Write the short pages, docs/benchmarks/README.md and docs/results/README.md, and the README's table from the results.

    python -m scripts.summaries

Every figure between the markers of these pages comes from a committed JSON file.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean
from typing import Any

from imgcal.training import RigExperiment, load_experiment
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json
from scripts.results.measuring import NETWORK, ONE_PASS

BENCHMARKS = ROOT / "docs" / "benchmarks"
TWO_STEPS = "2 LM steps from the factory"
QUESTION = ("question", "result", "benchmark (`python -m scripts.benchmarks.NAME`)")


def main() -> None:
    """Rewrite the tables of all pages."""
    for page, sections in pages().items():
        fill(ROOT / page, sections)


def pages() -> dict[str, dict[str, str]]:
    """Text of each section of each page, by the names of their markers."""
    peers = ("question", "imgcal", "best peer")
    return {
        "README.md": {"peers": markdown(peers, [*_recalibration_rows(), *_blob_rows()[:1]])},
        "docs/benchmarks/README.md": {
            "peers": markdown(peers, peer_rows()),
            "honesty": markdown(QUESTION, honesty_rows()),
            "alarms": markdown(QUESTION, alarm_rows()),
            "missed": missed_gates(),
        },
        "docs/results/README.md": {"paper": paper_table(), "real frames": real_frames_table()},
    }


def peer_rows() -> list[list[str]]:
    """Rows that compare imgcal with other tools of the field."""
    return [*_recalibration_rows(), *_blob_rows(), _identity_row(), _projection_row(), _splatting_row()]


def honesty_rows() -> list[list[str]]:
    """Rows that compare predicted errors with true ones."""
    ratios = [
        cell[unit]["ratio"]
        for rig in _benchmark("honesty_prediction")["rigs"].values()
        for cell in rig.values()
        for unit in ("px", "mm")
    ]
    over_time = _benchmark("rig_over_time")["normalized errors"]
    steady, drifting = (fmean(over_time[kind]["filter"]) for kind in ("steady", "drifting"))
    joint = [row["joint"] for row in _benchmark("lenses")["rows"]]
    moves = _benchmark("honesty_moves")
    lens = moves["steady"]["lens errors, one way"]
    calm = [row for name, row in moves["steady"].items() if name != "lens errors, one way"]
    images = moves["images"].values()
    total = sum(sum(row.values()) for row in images)
    scratch = _benchmark("from_scratch")["summary"]
    ours, colmap = scratch["imgcal from scratch"], scratch["COLMAP incremental mapping"]
    return [
        [
            "true error / predicted error (1 = correct)",
            f"{min(ratios):.2f} to {max(ratios):.2f} for O10, U7, T4 and room10, 1 to 20 snapshots",
            "honesty_prediction",
        ],
        [
            "normalized squared error (NEES / degrees of freedom) of a running rig, steady / drifting",
            f"{steady:.3f} / {drifting:.3f} over {len(over_time['steady']['filter'])} runs each",
            "rig_over_time",
        ],
        ["the same for each lens model", f"{min(joint):.2f} to {max(joint):.2f}", "lenses"],
        [
            "steady captures in which a camera is reported as moved",
            f"{_sum(calm, 'alarms')} of {_sum(calm, 'captures'):,}; "
            f"{lens['alarms']} of {lens['captures']} with lens errors and a single pass through the room",
            "honesty_moves",
        ],
        [
            "cameras with mirrored, rotated, swapped or late images",
            f"{_sum(images, 'found')} of {total} identified, {_sum(images, 'accepted') or 'none'} accepted",
            "honesty_moves",
        ],
        [
            "error without a factory calibration / error with one",
            f"{ours['ratio']:.2f} ({ours['rigs']} rigs, {ours['wrong'] or 'none'} wrong; "
            f"COLMAP: {colmap['wrong']} of {colmap['rigs']} wrong)",
            "from_scratch",
        ],
    ]


def alarm_rows() -> list[list[str]]:
    """Rows about the alarms of a running rig."""
    simulated = _benchmark("alarms")["found"]
    calm = [simulated["monitor steady"], simulated["monitor drifting"]]
    bumps = simulated["monitor bump"]
    real = _benchmark("real_stream")
    bump = next(row for row in real["bumps"] if row["degrees"] == 0.3)
    replayed = _benchmark("replayed_noise")["found"]["all"]
    return [
        [
            "false alarms, simulated rigs with white noise",
            f"{_sum(calm, 'alarms')} in {_sum(calm, 'snapshots'):,} snapshots",
            "alarms",
        ],
        [
            "bumps of 0.1 degrees, 1 mm, 3 px or 1 px that are detected within a second",
            f"{bumps['within_1_s']} of {bumps['bumps']}; right kind {100 * bumps['right_kind'] / bumps['bumps']:.1f} %",
            "alarms",
        ],
        [
            "false events in 40 s of a real recording without motion",
            f"{_sum(real['untouched'], 'false')} at any of {len(real['untouched'])} frame rates",
            "real_stream",
        ],
        [
            "rotations by 0.3 degrees in the real recording, one camera at a time, detected in time",
            f"{bump['in_time']} of {bump['bumps']}, after {bump['median_seen_s']:g} s in view (median)",
            "real_stream",
        ],
        [
            "false events in simulated rooms with the noise of the real recording",
            f"{replayed['false']} in {replayed['snapshots']:,} snapshots",
            "replayed_gates",
        ],
    ]


def missed_gates() -> str:
    """Sentences about the targets that are missed with replayed noise."""
    replayed = _benchmark("replayed_noise")["found"]["all"]
    lens = _benchmark("alarms")["found"]["keeper lens"]
    missed = []
    if not 0.9 <= replayed["nees"] <= 1.1:
        missed.append(f"The squared error is {replayed['nees']:.2f} times its covariance (target: 0.9 to 1.1).")
    if replayed["beyond_3_sigma"] > 0.01:
        missed.append(
            f"{100 * replayed['beyond_3_sigma']:.1f} % of the estimates are off by more than three standard deviations "
            "(target: 1 %)."
        )
    targets = "one target is" if len(missed) == 1 else "these targets are"
    found = [f"With replayed noise, {targets} missed. {' '.join(missed)}"] if missed else []
    if lens["alarms"]:
        found.append(
            f"Lens models that are wrong by 0.05 px over hundreds of pixels caused {lens['alarms']} false alarms in "
            f"{lens['snapshots']:,} snapshots."
        )
    return "\n".join(found)


def paper_table() -> str:
    """Compare our networks with the paper's, and with Levenberg-Marquardt steps."""
    rows = [
        _paper_row("points, O10, hemisphere, drift 2.5 %", "table1-row01"),
        _paper_row("points, O10, hemisphere, drift 10 %", "table1-row03"),
        _paper_row("points, T4, hemisphere, drift 2.5 %", "table1-row05"),
        _paper_row("images (ViT / CNN), O10, overhead, drift 2.5 %", "table1-row11", "table1-row11-cnn"),
        _paper_row("images (ViT / CNN), O10, overhead, drift 10 %", "table1-row13", "table1-row13-cnn"),
    ]
    head = ("rig and poses, cube8; RE in px", "paper, one pass", "ours, one pass", "ours, three passes")
    return markdown((*head, "two Levenberg-Marquardt steps"), rows)


def real_frames_table() -> str:
    """Count the cases of real frames, original and degraded, that each detector calibrates."""
    names = {"dots": "three-cameras-dots", "cavity": "cavity-two-cameras", "grid": "dot-grid-10x10"}
    detectors = ("classical", "matched", "auto")
    calibrated: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for row in read_json(RESULTS / "degraded_captures.json")["outcomes"]:
        calibrated[row["captures"], row["detector"]].append(not row["reason"])
    rows = [
        [name, str(len(calibrated[key, detectors[0]])), *(str(sum(calibrated[key, one])) for one in detectors)]
        for key, name in names.items()
    ]
    return markdown(("real frames", "cases", "blobs", "matched filter", "`auto`"), rows)


def _recalibration_rows() -> list[list[str]]:
    result = _benchmark("recalibration")
    counts = ("1", "20", "100")

    def cell(name: str, value: Callable[[Mapping[str, Any]], float]) -> str:
        return " / ".join(_digits(value(result["snapshots"][n]["methods"][name]), 2) for n in counts)

    def over_bound(name: str) -> str:
        rows = (result["snapshots"][n]["methods"][name] for n in counts)
        return " / ".join(f"{fmean(row['over_bound'].values()):.2f}" for row in rows)

    def time(row: Mapping[str, Any]) -> float:
        return row["p50"]

    mrcal = f"mrcal {cell('mrcal', time)} ms"
    at, converged = result["basin"]["scales"].index(8), result["basin"]["converged"]["1"]
    names = {
        "OpenCV calibrateCamera": "OpenCV",
        "scipy least_squares, same cost": "SciPy",
        "pycolmap rig adjustment": "pycolmap",
        "mrcal": "mrcal",
    }
    peers = ", ".join(f"{name} {100 * converged[key][at]:.0f}" for key, name in names.items())
    return [
        [
            "time and error of a calibration of ten cameras from 1 / 20 / 100 snapshots, start pose given",
            f"{cell('imgcal', time)} ms; {over_bound('imgcal')} times the Cramér-Rao bound (below 1: chance)",
            f"{mrcal}; {over_bound('mrcal')} times",
        ],
        [
            "the same without a start pose",
            f"{cell('imgcal, no start pose', time)} ms",
            f"{mrcal}, with a start pose",
        ],
        [
            "convergence from 8 times the factory errors (1 degree, 10 mm, 5 %, 10 px), one snapshot",
            f"{100 * converged['imgcal'][at]:.0f} %",
            f"{peers} %",
        ],
    ]


def _blob_rows() -> list[list[str]]:
    result = _benchmark("blobs")
    cells = {cell["cell"]: cell for cell in result["cells"]}
    usual, bright = cells["centre: radius 3, blur 0.7, noise 2"], cells["large bright areas"]
    ours, theirs = (usual["finders"][name]["rms"] for name in ("imgcal", "photutils centroid_2dg"))
    beside, trackpy = (bright["finders"][name] for name in ("imgcal", "trackpy.locate"))
    times = result["time"]
    return [
        [
            "blob centres, disc of radius 3 px, noise 2 grey levels",
            f"{ours:.2g} px (bound {usual['bound']:.2g}), {times['imgcal']['p50']:.1g} ms per frame",
            f"photutils {theirs:.2g} px, {times['photutils centroid_2dg']['p50']:.0f} ms",
        ],
        [
            "blob centres beside a large bright area",
            f"{beside['rms']:.2g} px, {100 * beside['recall']:.0f} % found",
            f"trackpy {trackpy['rms']:.2g} px, {100 * trackpy['recall']:.0f} % found",
        ],
    ]


def _identity_row() -> list[str]:
    cases = _benchmark("identity")["cases"]
    both = [cases[f"6 visible, 4 false {where}"] for where in ("anywhere", "near the pattern")]
    ours = [case["imgcal"] for case in both]
    peers = [case["the same, rig votes"] for case in both]
    wrong = _sum(ours, "wrong_labels")
    return [
        "labelling blobs, six markers and four false blobs per camera",
        f"{wrong or 'no'} wrong labels in {_sum(ours, 'snapshots')} snapshots, {_span(ours, 'ms_p50')} ms of CPU",
        f"P3P, assignment and a vote among the cameras: wrong labels in {_span(peers, 'wrong_percent')} % of the "
        f"snapshots, {_span(peers, 'ms_p50')} ms of CPU",
    ]


def _projection_row() -> list[str]:
    shape = next(s for s in _benchmark("projection")["shapes"] if s["kind"] == "camera" and s["points"] == 10_000)
    names = {"NumPy": "NumPy", "pycolmap `img_from_cam`": "pycolmap", "`cv2.projectPoints`": "OpenCV"}
    nanoseconds = {name: 1e6 * row["p50"] / shape["points"] for name, row in shape["rows"].items()}
    peers = ", ".join(f"{name} {_digits(nanoseconds[key], 2)}" for key, name in names.items())
    return [
        "projection, 10,000 points of one camera",
        f"{_digits(nanoseconds['**imgcal**'], 2)} ns per point",
        f"{peers} ns",
    ]


def _splatting_row() -> list[str]:
    scenes = [scene for scene in _benchmark("splatting")["scenes"] if scene["side"] == 448]

    def rates(name: str) -> str:
        rows = (row for scene in scenes for row in scene["rows"] if row["name"] == name)
        return " / ".join(f"{round(10e3 / row['forward']['p50'], -2):,.0f}" for row in rows)

    counts = " / ".join(str(scene["fiducials"]) for scene in scenes)
    question = f"colour-coded images, 448 px, {counts} fiducials"
    return [question, f"{rates('**imgcal**')} per second", f"Warp {rates('Warp kernel, a thread a window row')}"]


def _paper_row(what: str, *names: str) -> list[str]:
    experiment = load_experiment(names[0])
    assert isinstance(experiment, RigExperiment) and experiment.paper is not None
    runs = {name: [read_json(path) for path in sorted(RESULTS.glob(f"{name}-seed*.json"))] for name in names}

    def cell(stage: str, names: Iterable[str] = names) -> str:
        return " / ".join(_digits(fmean(run["exact"][stage]["mean"] for run in runs[name]), 2) for name in names)

    steps = cell(TWO_STEPS, names[:1]) + (", given the points" if len(names) > 1 else "")
    return [what, f"{experiment.paper.re_px:g}", cell(ONE_PASS), cell(NETWORK), steps]


def _benchmark(name: str) -> dict[str, Any]:
    return read_json(BENCHMARKS / f"{name}.json")


def _digits(value: float, digits: int) -> str:
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(value)))}f}"


def _sum(rows: Iterable[Mapping[str, Any]], key: str) -> int:
    return sum(row[key] for row in rows)


def _span(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    least, most = (f"{value:.0f}" for value in sorted(row[key] for row in rows))
    return least if least == most else f"{least} to {most}"


if __name__ == "__main__":
    command(main)
