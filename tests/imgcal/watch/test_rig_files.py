import shutil
import threading
import time
from dataclasses import replace

import pytest
import torch

from imgcal.io import load_rig_covariance, read_rig
from imgcal.watch import RigFiles
from tests.imgcal.watch.states import some_state


def until(condition):
    ends = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.01)


@pytest.fixture(scope="module")
def state():
    return some_state(time=1.7e9)


def test_the_rig_with_its_standard_deviations_and_its_history(state, tmp_path):
    files = RigFiles(tmp_path)
    files.write(state)
    files.write(replace(state, time=1.7e9 + 3600), keep=True)
    files.close()
    assert torch.allclose(read_rig(tmp_path / "rig.yaml").focal_length, state.rig.focal_length)
    assert torch.allclose(load_rig_covariance(tmp_path / "rig.yaml").std, state.std, rtol=1e-5)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.glob("history/*/*")] == [
        "history/2023-11-14/231320.000.yaml"
    ]
    assert not files.problems


def test_the_history_is_bounded_over_restarts(state, tmp_path):
    for day in range(6):
        files = RigFiles(tmp_path, most_kept=3)
        files.write(replace(state, time=1.7e9 + 86400 * day), keep=True)
        files.close()
    assert sorted(path.parent.name for path in tmp_path.glob("history/*/*")) == [
        "2023-11-17",
        "2023-11-18",
        "2023-11-19",
    ]
    assert len(list(tmp_path.glob("history/*"))) == 3


def test_a_reader_never_finds_half_a_rig(state, tmp_path):
    files, stop, found = RigFiles(tmp_path), threading.Event(), []
    files.write(state)

    def read():
        while not stop.is_set():
            if (tmp_path / "rig.yaml").exists():
                found.append(read_rig(tmp_path / "rig.yaml").num_cameras)
            time.sleep(0.02)

    reader = threading.Thread(target=read)
    reader.start()
    for number in range(6):
        files.write(replace(state, time=1.7e9 + number), keep=True)
    files.close()
    stop.set()
    reader.join()
    assert set(found) == {4}


def test_what_cannot_be_written_is_said_and_tried_again(state, tmp_path):
    (tmp_path / "rig.yaml").mkdir()
    files = RigFiles(tmp_path)
    files.write(state)
    while not files.problems:
        pass
    assert "rig.yaml" in files.problems["rig.yaml"]
    (tmp_path / "rig.yaml").rmdir()
    files.write(state)
    files.close()
    assert not files.problems and (tmp_path / "rig.yaml").is_file()


def test_the_rig_is_written_whatever_else_fails(state, tmp_path):
    done = []

    def refuse():
        raise OSError("no such luck")

    (tmp_path / "history").write_text("a file")
    files = RigFiles(tmp_path)
    files.write(state, keep=True, also=lambda: done.append("state"), then=refuse)
    files.close()
    assert (tmp_path / "rig.yaml").is_file() and done == ["state"]
    assert set(files.problems) == {"history", "frames"} and files.problems["frames"] == "no such luck"


def test_frames_are_kept_where_the_state_was_not_written_and_what_was_not_tried_is_not_forgotten(state, tmp_path):
    done = []

    def refuse():
        raise OSError("no such luck")

    files = RigFiles(tmp_path)
    files.write(state, also=refuse, then=lambda: done.append("frames"))
    until(lambda: files.problems)
    files.write(replace(state, time=1.7e9 + 60), keep=True)
    until(lambda: list(tmp_path.glob("history/*/*.yaml")))
    files.close()
    assert files.problems == {"state.json": "no such luck"} and not done


def test_a_history_that_somebody_has_tidied_up_goes_on(state, tmp_path):
    files = RigFiles(tmp_path, most_kept=2)
    for day in range(4):
        if day == 2:
            shutil.rmtree(tmp_path / "history")
        files.write(replace(state, time=1.7e9 + 86400 * day), keep=True)
        until(lambda day=day: len(list(tmp_path.glob("history/*/*.yaml"))) == 1 + day % 2)
    files.close()
    assert not files.problems


def test_what_cannot_be_done_is_said_with_its_place_and_in_words(tmp_path):
    (tmp_path / "history").touch()
    files = RigFiles(tmp_path)
    files.write(some_state(time=1.7e9), keep=True)
    files.close()
    assert files.problems == {"history": f"{tmp_path}/history/2023-11-14: Not a directory"}
