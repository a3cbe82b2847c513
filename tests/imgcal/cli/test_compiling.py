import numba

from imgcal.cli.compiling import HINT, tells_of_compiling


def test_compiling_is_told_once_and_counted(capsys):
    with tells_of_compiling() as compiled:
        for plus in (1, 2):
            numba.njit(lambda x, plus=plus: x + plus)(1)
    assert len(compiled) == 2
    assert capsys.readouterr().err == f"imgcal: {HINT}\n"
    with tells_of_compiling():
        pass
    numba.njit(lambda x: x + 3)(1)
    assert capsys.readouterr().err == ""
