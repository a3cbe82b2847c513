import pytest

from imgcal.cli.main import main
from imgcal.live_page import Demonstration


def test_the_address_is_printed_and_an_interruption_ends_it(monkeypatch, capsys):
    ran = []

    def run(self, rate):
        ran.append((rate, self.page.address))
        raise KeyboardInterrupt

    monkeypatch.setattr(Demonstration, "run", run)
    assert main(["demo", "live", "--rig", "T4", "--serve", "127.0.0.1:0", "--rate", "5"]) == 130
    assert ran[0][0] == 5 and ran[0][1].local
    assert f"live page: http://127.0.0.1:{ran[0][1].port}/ (this machine only)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["dead"], "found dead, expected live"),
        (["live", "--rate", "0"], "--rate: found 0.0"),
        (["live", "--serve", "a:b:c"], "expected [HOST:]PORT"),
        (["live", "--serve", "0.0.0.0:0", "--token", "short"], "expected 16 to 128"),
        (["live", "--serve", "192.0.2.1:80"], "192.0.2.1:80"),
        (["live", "--rig", "absent"], "absent"),
    ],
)
def test_a_command_line_that_cannot_be_served_is_one_line(arguments, expected, capsys):
    assert main(["demo", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("imgcal: ") and expected in line
