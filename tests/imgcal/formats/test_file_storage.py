from pathlib import Path

import cv2
import numpy as np
import pytest

from imgcal.formats.file_storage import matrix, merge_storages, storage_text
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.source import Source

CONTENT = {
    "K": np.array([[900.5, 0, 640], [0, 905, 400], [0, 0, 1.0]]),
    "n": np.array([[3], [4]]),
    "names": ["a b", 'with "quotes"'],
    "width": 1280,
    "tiny": 1e-17,
    "title": "x",
}


def test_opencv_reads_what_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    path.write_bytes(storage_text(CONTENT))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert np.array_equal(storage.getNode("K").mat(), CONTENT["K"])
    assert np.array_equal(storage.getNode("n").mat(), CONTENT["n"])
    assert [storage.getNode("names").at(i).string() for i in range(2)] == CONTENT["names"]
    assert storage.getNode("width").real() == 1280
    assert storage.getNode("tiny").real() == 1e-17


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_what_opencv_writes_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("K", CONTENT["K"])
    storage.write("three", np.arange(12.0).reshape(2, 2, 3))  # channels
    storage.write("whole", np.array([[1, 2]], np.int32))
    storage.write("size", 1280)
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    storage.write("", "left")
    storage.write("", "right")
    storage.endWriteStruct()
    storage.release()
    found = merge_storages(Source([path]))
    assert np.array_equal(matrix(found["K"], "K"), CONTENT["K"])
    assert np.array_equal(matrix(found["three"], "three").ravel(), np.arange(12.0))
    assert matrix(found["whole"], "whole").tolist() == [[1, 2]]
    assert float(found["size"]) == 1280
    if suffix != "xml":  # XML has no quotes around texts, and puts several into one
        assert found["names"] == ["left", "right"]


def test_a_matrix_has_as_many_numbers_as_it_says() -> None:
    sound = {"rows": 2, "cols": 1, "dt": '"3d"', "data": [1, 2, 3, 4, 5, 6]}
    assert matrix(sound, "m").tolist() == [[1, 2, 3], [4, 5, 6]]
    assert matrix({"sizes": [2, 3], "dt": "d", "data": [1, 2, 3, 4, 5, 6]}, "m").shape == (2, 3)
    for bad in ({**sound, "rows": 3}, {**sound, "rows": -2}, {**sound, "rows": 10**9}, {"a": 1}):
        with pytest.raises(FormatError, match=r"m: (found|expected a matrix)"):
            matrix(bad, "m")
