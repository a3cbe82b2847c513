from pathlib import Path

import cv2
import numpy as np
import pytest

import imgcal
from imgcal.io import open_capture
from imgcal.pipeline import capture_sight, detect_capture, read_masks

SAMPLE = Path("data/samples/O10")


def test_blobs_of_a_capture_are_those_of_its_frames() -> None:
    rig = imgcal.load_rig(str(SAMPLE / "rig.yaml"))
    capture = open_capture(SAMPLE, rig)
    found, first = detect_capture(capture, 1, 3)
    assert found.snapshot_names == capture.snapshot_names[1:3]
    direct, _ = detect_capture(capture)
    whole = {tuple(uv) for uv in direct.of_snapshots(1, 3).uv}
    assert {tuple(uv) for uv in found.uv} <= whole and len(found.uv) > 0.9 * len(whole)  # dim ones are judged together
    assert set(first) == set(rig.camera_names)
    assert all(np.array_equal(first[name], frame) for name, frame in capture.frames_of(1).items())


def test_blobs_under_a_mask_are_not_used(tmp_path: Path) -> None:
    frame = np.full((60, 80), 10, np.uint8)
    for u in (20, 60):
        cv2.circle(frame, (u, 30), 5, 250, -1, cv2.LINE_AA)
    (tmp_path / "frames" / "a").mkdir(parents=True)
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "a" / "0.png"), frame)
    mask = np.zeros_like(frame)
    mask[:, 40:] = 255
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), mask)
    capture = open_capture(tmp_path)
    (hidden,) = read_masks(capture).values()
    assert hidden[:, 40:].all() and not hidden[:, :40].any()
    found, _ = detect_capture(capture)
    np.testing.assert_allclose(found.select(found.usable).uv, [[20.0, 30.0]], atol=0.2)


def test_another_detector_looks_at_the_chosen_snapshots() -> None:
    capture = open_capture(SAMPLE)
    sight = capture_sight(capture, "matched", first=2)
    name = capture.camera_names[0]
    assert np.array_equal(sight.frames(0)[name], capture.frames_of(2)[name])
    with pytest.raises(imgcal.InputError, match="detector"):
        capture_sight(capture, "nobody")
