import signal
import subprocess
import sys

import pytest

SIGNALLED = """
import os, signal, sys
from imgcal.cli.interruption import stop_at_signals
number = getattr(signal, sys.argv[1])
signal.signal(number, signal.SIG_IGN if sys.argv[2] == "ignored" else signal.SIG_DFL)
with stop_at_signals() as stopped:
    os.kill(os.getpid(), number)
    print(stopped.is_set(), stopped.interrupted)
"""


@pytest.mark.parametrize("state", ["default", "ignored"])
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_loop_ends_cleanly_at_a_signal_unless_it_is_ignored(number, state):
    if not hasattr(signal, number):
        pytest.skip(f"no {number} on this system")
    found = subprocess.run([sys.executable, "-c", SIGNALLED, number, state], capture_output=True, text=True)
    stopped = state == "default"
    assert (found.returncode, found.stdout) == (0, f"{stopped} {stopped and number == 'SIGINT'}\n")
