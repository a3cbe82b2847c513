"""`imgcal describe`: what the keys of a file mean."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

from imgcal.cli import arguments
from imgcal.io import Key, list_keys

WIDTH = 120


class Describe(arguments.Describe):
    """Run `imgcal describe`."""

    def run(self) -> None:
        """Print the keys of every task, and what each kind of network lets change."""
        from imgcal.networks import PRESETS
        from imgcal.training import KINDS, Experiment

        common = list(list_keys(Experiment))
        print(table("All experiments: `--set KEY=VALUE`, or in the file", common))
        for task, kind in KINDS.items():
            own = [key for key in list_keys(kind) if key.path not in {shared.path for shared in common}]
            print(table(f"task: {task} ({(kind.__doc__ or '').splitlines()[0].rstrip('.')})", own))
        variants: dict[type, list[str]] = {}
        for name, variant in PRESETS.items():
            variants.setdefault(type(variant), []).append(name)
        for variant_type, names in variants.items():
            head = f"network.preset: {', '.join(names)}; defaults are those of {names[0]}"
            print(table(head, list_keys(variant_type, "network.change.")))


def table(head: str, keys: Iterable[Key]) -> str:
    """Set keys as lines: path and default, then type and meaning below where they do not fit."""
    keys = list(keys)
    first = max(len(f"{key.path}: {key.default}".rstrip()) for key in keys) + 2
    lines = [head, ""]
    for key in keys:
        words = f"{key.kind}. {key.meaning}" if key.meaning else key.kind
        wrapped = textwrap.wrap(words, WIDTH - first - 2)
        lines.append(f"  {f'{key.path}: {key.default}'.rstrip():{first}}{wrapped[0]}")
        lines += [" " * (first + 2) + line for line in wrapped[1:]]
    return "\n".join(lines) + "\n"
