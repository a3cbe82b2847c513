"""The beginning of a program that lists what numba compiles while it runs a command: `Compiled.names`."""

LISTEN = """
from numba.core import event

class Compiled(event.Listener):
    names = []
    def on_start(self, happening):
        self.names.append(happening.data["dispatcher"].py_func.__qualname__)
    def on_end(self, happening):
        pass

event.register("numba:compile", Compiled())
from imgcal.cli.main import main
"""
