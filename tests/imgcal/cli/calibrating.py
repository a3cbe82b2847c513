"""The command as its tests give it."""

from imgcal.cli.main import main


def calibrate(workplace, source, out, *more):
    arguments = ["calibrate", str(source), "--rig", str(workplace.rig), "--object", str(workplace.object)]
    return main([*arguments, "--out", str(out), *more])


def one_line(capsys):
    error = capsys.readouterr().err
    assert "Traceback" not in error
    said = [line for line in error.splitlines() if line.startswith("imgcal: ")]
    lines = [line for line in said if "compiling for this machine" not in line]
    assert len(lines) == 1, error
    return lines[0]
