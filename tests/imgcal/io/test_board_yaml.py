"""Files of printed boards."""

import pytest

import imgcal
from imgcal.errors import InputError
from imgcal.io import save_object
from imgcal.io.board_yaml import board_text

CHARUCO = (
    "format: imgcal-board/1\ntype: charuco\ncolumns: 4\nrows: 5\nsquare: 54\nmarker: 40.5\ndictionary: DICT_4X4_50\n"
)


@pytest.mark.parametrize("kind", ["charuco", "aprilgrid", "checkerboard", "circles"])
def test_what_is_written_is_read_again(kind, tmp_path):
    obj = imgcal.load_object(kind)
    (tmp_path / "again.yaml").write_text(board_text(obj))
    again = imgcal.load_object(tmp_path / "again.yaml")
    assert again.board == obj.board
    assert (again.points == obj.points).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("charuco", "charucco"), "type: found 'charucco', expected one of"),
        (("40.5", "60"), "found markers of 60 mm at a distance of 54 mm"),
        (("columns: 4", "columns: 2"), "expected at least 3"),
        (("square: 54\n", ""), "square"),
        (("imgcal-board/1", "imgcal-rig/1"), "expected 'imgcal-board/1'"),
    ],
)
def test_says_what_is_wrong_with_a_file_in_one_line(change, words, tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text(CHARUCO.replace(*change))
    with pytest.raises(InputError, match=words) as error:
        imgcal.load_object(path)
    assert "\n" not in str(error.value) and "board.yaml" in str(error.value)


def test_tables_number_fiducials_as_the_object_does(tmp_path):
    (tmp_path / "object.csv").write_text("fiducial,x,y,z\n60,0,0,0\n7,10,0,0\n8,0,10,0\n90,0,0,10\n")
    (tmp_path / "seen.csv").write_text("snapshot,camera,u,v,fiducial\n0,a,5,5,90\n0,a,9,9,7\n0,a,3,3,\n")
    obj = imgcal.load_object(tmp_path / "object.csv")
    assert imgcal.io.load_detections(tmp_path / "seen.csv", None, obj.rows).fiducial.tolist() == [3, 1, -1]
    save_object(obj, tmp_path / "again.csv")
    assert imgcal.load_object(tmp_path / "again.csv").labels == (60, 7, 8, 90)
    (tmp_path / "seen.csv").write_text("snapshot,camera,u,v,fiducial\n0,a,5,5,61\n")
    with pytest.raises(InputError, match="line 2: fiducial: found 61"):
        imgcal.io.load_detections(tmp_path / "seen.csv", None, obj.rows)
