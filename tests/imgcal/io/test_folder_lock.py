import os
import signal
import subprocess
import sys

import pytest

from imgcal.errors import InputError
from imgcal.io import folder_lock, holding

HOLD = (
    "import sys; from imgcal.io import holding\nwith holding(sys.argv[1]): print('held', flush=True); sys.stdin.read()"
)


def test_only_one_works_in_a_folder_and_its_death_frees_it(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="out: another imgcal is using this folder"), holding(tmp_path / "out"):
            pass
        other.send_signal(signal.SIGKILL)
    with holding(tmp_path / "out") as folder:
        assert not list(folder.iterdir())


def test_it_is_free_again_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), holding(tmp_path):
            raise ZeroDivisionError


def test_folders_that_were_made_stay_where_something_came_to_be(tmp_path):
    with holding(tmp_path / "deep" / "out") as folder:
        assert folder.is_dir()
    assert not (tmp_path / "deep").exists()
    (tmp_path / "old").mkdir()
    with holding(tmp_path / "old"):
        pass
    with holding(tmp_path / "deep" / "out") as folder:
        (folder / "file").touch()
    assert (tmp_path / "old").is_dir() and folder.is_dir()


def test_what_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be made"), holding(tmp_path / "file" / "out"):
        pass


@pytest.mark.parametrize("locks", [None, "no locks"])
def test_where_there_are_no_locks_nobody_is_kept_out(locks, tmp_path, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(os.strerror(95))

    if locks is None:
        monkeypatch.setattr(folder_lock, "fcntl", None)
    elif folder_lock.fcntl is not None:
        monkeypatch.setattr(folder_lock.fcntl, "flock", refuse)
    with holding(tmp_path), holding(tmp_path) as folder:
        assert folder == tmp_path
