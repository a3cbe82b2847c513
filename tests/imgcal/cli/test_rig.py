import shutil

from imgcal.cli.main import main
from imgcal.io import load_cameras, read_rig


def test_a_ring_is_written_and_not_over_another_file(tmp_path, capsys):
    out = tmp_path / "ring.yaml"
    arguments = ["rig", "look-at", "--shape", "ring", "--cameras", "5", "--volume", "-1", "-1", "0", "1", "1", "2"]
    assert main([*arguments, "--out", str(out)]) == 0
    rig = read_rig(out)
    assert (rig.name, rig.num_cameras, rig.volume.high) == ("ring", 5, (1.0, 1.0, 2.0))
    before = out.read_bytes()
    assert main([*arguments, "--out", str(out)]) == 2
    assert "expected a new file" in capsys.readouterr().err and out.read_bytes() == before
    assert main([*arguments, "--cameras", "0", "--out", str(tmp_path / "none.yaml")]) == 2
    assert not (tmp_path / "none.yaml").exists()


def test_cameras_of_a_capture(workplace, tmp_path):
    out = tmp_path / "cameras.yaml"
    assert main(["rig", "cameras", str(workplace.capture), "--field-of-view-deg", "60", "--out", str(out)]) == 0
    cameras = load_cameras(out)
    assert cameras.camera_names == read_rig(workplace.rig).camera_names
    assert cameras.image_size.tolist() == [[512, 272]] * 4


def test_cameras_without_frames_are_named(workplace, tmp_path, capsys):
    capture, out = tmp_path / "capture", tmp_path / "cameras.yaml"
    shutil.copytree(workplace.capture, capture)
    empty = read_rig(workplace.rig).camera_names[1:3]
    for name in empty:
        for frame in (capture / "frames" / name).iterdir():
            frame.unlink()
    assert main(["rig", "cameras", str(capture), "--field-of-view-deg", "60", "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert f"{capture}: found no readable frame of {empty[0]}, {empty[1]}, expected some of each camera" in told
    assert not out.exists()
