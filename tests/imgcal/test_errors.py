from imgcal.cli.main import main
from imgcal.errors import RefusedError


def test_each_interface_gets_its_own_advice():
    error = RefusedError("camera cam04: sees nothing", python="rig.select leaves it out", command="use --without cam04")
    assert str(error) == "camera cam04: sees nothing; rig.select leaves it out"
    assert error.for_command == "camera cam04: sees nothing; use --without cam04"
    assert error.reason == "camera cam04: sees nothing"
    assert str(RefusedError("no")) == RefusedError("no").for_command == "no"


def test_commands_print_what_a_command_can_do(monkeypatch, capsys):
    def refuse(self):
        raise RefusedError("it is so", python="call f()", command="use --f")

    monkeypatch.setattr("imgcal.cli.score.Score.run", refuse)
    assert main(["score", "capture", "--rig", "O10", "--object", "cube8"]) == 3
    assert capsys.readouterr().err == "imgcal: it is so; use --f\n"
