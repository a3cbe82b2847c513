import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from imgcal.cli.common import keep_memory

def faults():
    for number in range(12):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        arrays = [np.ones(1 << 20, np.float32) for _ in range(8)]  # 4 MB each
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(faults(), keep_memory(), faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_pages_that_were_freed_are_used_again():
    run = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    before, kept, after = run.stdout.split()
    assert kept == "True" and int(after) < 100 < 1000 < int(before)
