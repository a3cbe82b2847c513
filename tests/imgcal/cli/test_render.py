import cv2
import numpy as np

from imgcal.cli.main import main
from imgcal.io import load_detections, load_object


def test_every_dot_has_its_colour_at_its_place(workplace, tmp_path):
    out = tmp_path / "coded"
    arguments = ["render", str(workplace.capture), "--rig", str(workplace.rig), "--object", str(workplace.object)]
    assert main([*arguments, "--out", str(out), "--size", "224", "--snapshots", "1:2"]) == 0
    truth = load_detections(workplace.capture / "truth" / "detections.csv")
    colours = load_object(workplace.object).colours.numpy()
    image = cv2.imread(str(out / "cam02" / "00001.png"))[..., ::-1].astype(float)
    assert image.shape == (224, 224, 3)
    rows = (truth.snapshot == 1) & (truth.camera == 1)
    for uv, fiducial in zip(truth.uv[rows], truth.fiducial[rows], strict=True):
        column, row = np.rint((uv + 0.5) * 224 / np.array([512, 272]) - 0.5).astype(int)
        pixel = image[row, column]
        cosine = pixel @ colours[fiducial] / np.linalg.norm(pixel) / np.linalg.norm(colours[fiducial])
        assert cosine > 0.99
    assert sorted(p.name for p in out.iterdir()) == ["cam01", "cam02", "cam03", "cam04"]
    assert [p.name for p in (out / "cam01").iterdir()] == ["00001.png"]


def test_images_that_are_there_are_not_overwritten_nor_mixed_with_others(workplace, tmp_path, monkeypatch, capsys):
    out = tmp_path / "coded"
    arguments = ["render", str(workplace.capture), "--rig", str(workplace.rig), "--object", str(workplace.object)]
    arguments += ["--out", str(out), "--size", "32"]
    written = []

    def fails_in_the_middle(path, image):
        written.append(path)
        if len(written) == 5:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("imgcal.cli.render.write_image", fails_in_the_middle)
        assert main(arguments) == 2
    assert not out.exists()
    assert main(arguments) == 0
    before = {path: path.read_bytes() for path in out.rglob("*.png")}
    assert len(before) == 12
    assert main([*arguments, "--snapshots", "0:1"]) == 2
    assert "expected a new folder" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in out.rglob("*.png")}
