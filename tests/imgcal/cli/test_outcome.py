from pathlib import Path

import pytest
import torch

from imgcal.cli.outcome import Findings, predicted_line, print_outcome
from imgcal.estimation import Gauge
from imgcal.pipeline import Coverage, Motion

PREDICTED = {"median_mm": 0.1234, "p95_mm": 0.5, "median_px": 0.05, "p95_px": 0.111}
RESULT = {
    "first_guess": {"network": "points", "rms_px": 1.5, "used": False},
    "rms_px_before": None,
    "rms_px_after": 0.0512,
    "predicted_error": {**PREDICTED, "worst_camera": "cam03", "worst_camera_px": 0.2},
    "scale": {"note": "scale comes from the object file"},
    "delays": None,
    "unsynchronized": None,
    "board_bend": None,
    "lights": None,
    "doubtful": [],
    "repeats": {"note": "3 blobs are listed twice"},
    "rests": {"note": "2 snapshots show the object at rest"},
    "unit_doubt": "rig and object seem to be in metres",
    "identity": "unique",
    "snapshots_used": 5,
    "snapshots_rejected": 1,
    "prior_too_narrow": {"focal_length": 2.31},
    "object": [{"fiducial": 3, "offset_mm": 1.23, "sigma_mm": 0.1}, {"fiducial": 4, "offset_mm": 0.1, "sigma_mm": 0.1}],
    "object_displaced": [3],
    "object_lost": [6],
}

KNOWN = Coverage(("a",), (0.9,), {}, ())


def test_the_predicted_error_is_one_line_of_what_is_known() -> None:
    words = "predicted error in the working volume 0.12 mm (95 %: 0.5), 0.05 px (95 %: 0.11)"
    assert predicted_line(PREDICTED | {"worst_camera": None, "worst_camera_px": None}) == words
    assert predicted_line(RESULT["predicted_error"]) == f"{words}, worst camera cam03 0.2 px"
    nothing = dict.fromkeys([*PREDICTED, "worst_camera", "worst_camera_px"])
    assert predicted_line(nothing) == "predicted error in the working volume unknown"


def test_results_go_to_standard_output_and_notes_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    found = Findings(Motion(Gauge.from_camera(0, 1), ("a",), torch.zeros(1, 15), torch.ones(1, 15)), KNOWN, True)
    print_outcome(RESULT, found, Path("out"), report=True)
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "reprojection error without a factory calibration 0.0512 px (RMS)",
        predicted_line(RESULT["predicted_error"]) + "; scale comes from the object file",
        "identity unique, 5 snapshots used, 1 rejected",
        "rig     out/rig.yaml",
        "object  out/object.csv",
        "result  out/result.json",
        "report  out/report.html",
    ]
    notes = said.err.splitlines()
    assert all(note.startswith("note: ") for note in notes) and len(notes) == 7
    assert (
        "network's guesses fits no better" in notes[0] and notes.pop(1) == "note: rig and object seem to be in metres"
    )
    assert notes.pop(1) == "note: 3 blobs are listed twice"
    assert notes.pop(1) == "note: 2 snapshots show the object at rest"
    assert "focal length drifted 2.3 times" in notes[1]
    assert "fiducial 3 of the object is 1.23 +- 0.1 mm from its place" in notes[2] and "fiducial 6" in notes[3]
