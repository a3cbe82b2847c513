import json
import os
import sys
import time
from dataclasses import replace

import pytest

from imgcal.errors import InputError
from imgcal.watch import Hook
from imgcal.watch import hook as module
from tests.imgcal.watch.states import event

EVIL = '"; touch evil; $(touch evil) `touch evil` | touch evil'


def script(tmp_path, code):
    path = tmp_path / "hook.py"
    path.write_text(code)
    return f"{sys.executable} -S {path} {tmp_path}/out"


def until(condition, seconds=90.0):
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.01)


def test_the_event_is_standard_input_and_no_shell_sees_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = (
        "import os, sys\n"
        "open(sys.argv[1], 'a').write(sys.stdin.read() + os.environ['IMGCAL_EVENT'] + os.environ['IMGCAL_CAMERA'])"
    )
    hook = Hook(script(tmp_path, code))
    hook.notify(event(7, camera="cam02", message=EVIL))
    hook.close()
    line, rest = (tmp_path / "out").read_text().split("\n")
    assert json.loads(line)["message"] == EVIL and rest == "movedcam02"
    assert not (tmp_path / "evil").exists() and (hook.failed, hook.dropped) == (0, 0)


def test_one_that_hangs_is_killed_with_what_it_started_and_never_waited_for(tmp_path):
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([{sys.executable!r}, '-S', '-c', 'import time; time.sleep(60)'])\n"
        "open(sys.argv[1], 'a').write(f'{child.pid}\\n'); time.sleep(60)"
    )
    hook = Hook(script(tmp_path, code), timeout=4.0)
    started = time.monotonic()
    hook.notify(event())
    assert time.monotonic() - started < 3.0
    until(lambda: hook.failed == 1)
    (child,) = (tmp_path / "out").read_text().split()
    until(lambda: not _runs(child))
    hook.close()
    assert hook.problem.endswith(" was killed after 4 s")


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_more_events_than_it_can_take_are_dropped_and_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_WAITING", 3)
    hook = Hook(script(tmp_path, "import sys, time; time.sleep(0.3); open(sys.argv[1], 'a').write(sys.stdin.read())"))
    for number in range(10):
        hook.notify(event(number))
    hook.close()
    names = [json.loads(line)["snapshot"] for line in (tmp_path / "out").read_text().splitlines()]
    assert names[-3:] == ["00007", "00008", "00009"] and len(names) + hook.dropped == 10
    assert hook.problem == "--hook: events were dropped: more than 3 events waited for the command"


def test_one_that_fails_is_counted(tmp_path):
    hook = Hook(script(tmp_path, "raise SystemExit(3)"))
    hook.notify(event())
    hook.close()
    assert hook.failed == 1 and hook.problem.endswith(" ended with exit code 3")


def test_what_is_left_at_the_end_is_killed_or_dropped_in_time(tmp_path):
    code = "import os, sys, time\nopen(sys.argv[1], 'a').write(f'{os.getpid()}\\n')\ntime.sleep(60)"
    hook = Hook(script(tmp_path, code), timeout=2.0)
    for number in range(5):
        hook.notify(event(number))
    until(lambda: (tmp_path / "out").is_file() and (tmp_path / "out").read_text().endswith("\n"))
    hook.close()
    runs = (tmp_path / "out").read_text().split()
    assert hook.failed + hook.dropped == 5 and hook.dropped > 0 and "in time" in hook.problem
    until(lambda: not any(_runs(process) for process in runs))


@pytest.mark.parametrize("command", ["", "no-such-program --now", "echo 'open", "   "])
def test_commands_that_are_none(command):
    with pytest.raises(InputError, match="--hook: found"):
        Hook(command)


def test_an_event_that_cannot_be_written_is_counted_and_the_next_one_is_told(tmp_path):
    hook = Hook(script(tmp_path, "import sys; open(sys.argv[1], 'a').write(sys.stdin.read())"))
    hook.notify(replace(event(1), time="never"))
    hook.notify(replace(event(2), size=float("inf")))
    hook.close()
    assert hook.failed == 1 and json.loads((tmp_path / "out").read_text())["snapshot"] == "00002"


def test_one_that_hangs_is_killed_where_there_are_no_process_groups(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "killpg")
    hook = Hook(script(tmp_path, "import time; time.sleep(600)"), timeout=0.2)
    hook.notify(event(7))
    until(lambda: hook.failed == 1)
    assert "was killed after" in hook.problem
    hook.close()
