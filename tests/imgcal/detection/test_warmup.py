import os
import subprocess
import sys
from pathlib import Path

CODE = """
import sys
from renderers.interpreting import Interpretable

called = set()
Interpretable.choose = lambda self, *arguments: called.add(self) or self.interpret
from imgcal.detection import candidates, fitting, kernels, moments, territory
from imgcal.detection.warmup import warm_up_detection

warm_up_detection()
assert "torch" not in sys.modules, "slow to import"
for module in (candidates, fitting, kernels, moments, territory):
    for name, value in vars(module).items():
        if hasattr(value, "interpretable") and value.py_func.__module__ == module.__name__:
            print(name, value.interpretable.limit == 0, value.interpretable in called)
"""


def test_all_functions_that_are_slow_to_interpret_are_called_without_torch(tmp_path: Path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    rows = [line.split() for line in done.stdout.splitlines()]
    heavy = {name for name, slow, _ in rows if slow == "True"}
    assert {"_average", "_smooth_tiles", "find_shape", "_products"} < heavy
    assert not heavy & {name for name, _, called in rows if called == "False"}
