"""`imgcal export`: a trained network for another runtime."""

from __future__ import annotations

import tempfile
from pathlib import Path

from imgcal.cli import arguments
from imgcal.errors import InputError
from imgcal.extras import advice, missing
from imgcal.io import model_file, write_bytes
from imgcal.networks import OPSET, TOLERANCE, load_program, save_exported, save_onnx

SUFFIXES = {"onnx": ".onnx", "pt2": ".pt2"}
MOST = 4096
"""Patches, crops or snapshots, and fiducials."""


class Export(arguments.Export):
    """Run `imgcal export`."""

    def run(self) -> None:
        """Load, write, compare."""
        if self.out.suffix != SUFFIXES[self.to]:
            raise InputError(
                f"--out: found {self.out}, expected a name that ends in {SUFFIXES[self.to]}, for --to {self.to}"
            )
        for name, value in (("count", self.count), ("fiducials", self.fiducials)):
            if not 1 <= value <= MOST:
                raise InputError(f"--{name}: found {value}, expected 1 to {MOST}")
        library = missing("onnx", "onnxruntime") if self.to == "onnx" else None
        if library is not None:
            raise InputError(f"--to onnx {advice(library)}")
        program = load_program(model_file(self.model), self.count, self.fiducials)
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / self.out.name
            off = (save_onnx if self.to == "onnx" else save_exported)(program, made)
            if not off <= TOLERANCE:
                found = f"the exported network gives different numbers (by {off:.1e}, {TOLERANCE:.0e} allowed)"
                raise InputError(f"{self.model}: {found}; not written")
            content = made.read_bytes()
        write_bytes(self.out, content)
        for kind, named in (("in", program.inputs), ("out", program.outputs)):
            for name, said in named.items():
                print(f"{kind:>3}: {name}: {said}")
        what = f"opset {OPSET}" if self.to == "onnx" else "the first axis may have any length"
        print(f"{program.kind}, {what}, {len(content) / 1e6:.2f} MB, differs from PyTorch by {off:.1e}: {self.out}")
