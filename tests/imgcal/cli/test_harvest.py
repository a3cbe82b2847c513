from imgcal.cli.main import main
from imgcal.training import load_splits


def test_a_calibrated_capture_becomes_a_dataset_with_a_card(workplace, tmp_path, capsys):
    rig, out = workplace.capture / "truth" / "rig.yaml", tmp_path / "dataset"
    given = ["harvest", str(workplace.capture), "--rig", str(rig), "--object", str(workplace.object)]
    assert main([*given, "--out", str(out)]) == 0
    train, held_out = load_splits(out)
    card = (out / "README.md").read_text()
    said = capsys.readouterr().err
    for part in (train, held_out):
        assert len(part) and f"| {len(part)} | {int(part.seen.sum())} |" in card
        assert f"{len(part)} crops with {int(part.seen.sum())} markers" in said
    assert main([*given, "--out", str(out)]) == 2  # a dataset is not overwritten
    assert "found a dataset there already, expected a new folder" in capsys.readouterr().err
    again = tmp_path / "again"
    assert main([*given, "--out", str(again)]) == 0  # the same files
    assert (load_splits(again)[0].crops.nan_to_num() == train.crops.nan_to_num()).all()


def test_without_patches_the_reason_is_told(workplace, tmp_path, capsys, monkeypatch):
    rig, out = workplace.capture / "truth" / "rig.yaml", tmp_path / "dataset"
    given = ["harvest", str(workplace.capture), "--rig", str(rig), "--object", str(workplace.object)]
    monkeypatch.setattr("imgcal.training.labelled_crops.LARGEST_PATCH_SIGMA", 0.0)
    assert main([*given, "--out", str(out)]) == 0
    assert "note: no patches for the measurer: too few markers have a place" in capsys.readouterr().err
    assert not (out / "train_patches.safetensors").exists()


def test_what_cannot_be_harvested_leaves_nothing(workplace, tmp_path, capsys):
    out = tmp_path / "dataset"
    given = ["harvest", str(workplace.capture), "--rig", str(workplace.rig), "--object", "cube27", "--out", str(out)]
    assert main(given) == 3
    assert "imgcal: " in capsys.readouterr().err and not out.exists()


def test_train_from_a_folder_that_is_no_dataset_is_one_line(tmp_path, capsys):
    assert main(["train", "ir-cnn", "--from", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    assert "train.safetensors" in capsys.readouterr().err


def test_of_unknown_markers_nothing_can_be_harvested(workplace, tmp_path, capsys):
    given = ["harvest", str(workplace.capture), "--rig", str(workplace.rig), "--object", "lights"]
    assert main([*given, "--out", str(tmp_path / "dataset")]) == 2
    said = "object lights: found unknown markers, expected the file of an object to harvest crops"
    assert capsys.readouterr().err == f"imgcal: {said}\n" and not (tmp_path / "dataset").exists()
