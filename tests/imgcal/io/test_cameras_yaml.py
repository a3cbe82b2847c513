import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_cameras, read_rig, save_cameras, save_rig

TEXT = """\
format: imgcal-cameras/1
cameras:
  - {name: a, image_size: [1280, 1024], field_of_view: 90}
  - {name: b, image_size: [640, 480], focal_length: [500, 505.5], principal_point: [300, 200]}
"""


def test_reads_angles_and_lengths(tmp_path):
    (tmp_path / "c.yaml").write_text(TEXT)
    cameras = load_cameras(tmp_path / "c.yaml")
    torch.testing.assert_close(cameras.focal_length, torch.tensor([[640, 640], [500, 505.5]], dtype=torch.float64))
    assert cameras.principal_point.tolist() == [[639.5, 511.5], [300.0, 200.0]]
    assert cameras.prior.focal_length == 0.15 and not cameras.distortion.any()


def test_a_rig_is_read_without_its_places():
    cameras = load_cameras("T4")
    assert cameras.camera_names[0] == "cam01" and not cameras.positions.any()


@pytest.mark.parametrize(
    "line", ['format: "imgcal-rig/1"', "'format': imgcal-rig/1  # ours", "format:   imgcal-rig/1 "]
)
def test_the_format_of_a_rig_may_be_in_quotes_and_before_a_remark(line, tmp_path):
    save_rig(read_rig("T4"), tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("format: imgcal-rig/1", line))
    assert load_cameras(tmp_path / "rig.yaml").num_cameras == read_rig(tmp_path / "rig.yaml").num_cameras == 4


def test_what_is_written_can_be_read(tmp_path):
    save_cameras({"left": (640, 480)}, 60, tmp_path / "c.yaml")
    assert load_cameras(tmp_path / "c.yaml").image_size.tolist() == [[640, 480]]
    with pytest.raises(InputError, match="field_of_view"):
        save_cameras({"left": (640, 480)}, 190.0, tmp_path / "d.yaml")
    assert not (tmp_path / "d.yaml").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("imgcal-cameras/1", "imgcal-camera/1", "expected `format: imgcal-cameras/1`"),
        (", field_of_view: 90", "", "camera a: expected either `field_of_view`"),
        ("field_of_view: 90", "field_of_view: 90, focal_length: 3", "camera a: expected either"),
        ("field_of_view: 90", "field_of_view: 180", "field_of_view: found 180"),
        ("name: b", "name: a", "camera name a more than once"),
        ("name: b", "name: a/b", "can be a file name"),
        ("[640, 480]", "[60000, 60000]", "image_size"),
        ("505.5]", "-1]", "focal_length"),
    ],
)
def test_bad_files_give_one_clear_line(old, new, message, tmp_path):
    (tmp_path / "c.yaml").write_text(TEXT.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_cameras(tmp_path / "c.yaml")
    assert message in str(caught.value) and "\n" not in str(caught.value)
