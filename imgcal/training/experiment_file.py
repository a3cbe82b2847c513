"""Experiment files: YAML, `format: imgcal-experiment/1`; the key `task` selects the training and its keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, overload

from imgcal.errors import InputError
from imgcal.io import (
    Flow,
    StrictModel,
    StrictRecord,
    find_file,
    nearest,
    parse_yaml,
    read_yaml_mapping,
    validate,
    write_text,
    yaml_text,
)
from imgcal.messages import quote
from imgcal.training.experiment import Experiment
from imgcal.training.infrared_task import InfraredExperiment
from imgcal.training.measurer_task import MeasurerExperiment
from imgcal.training.positions import PositionsExperiment
from imgcal.training.rigs import RigExperiment

FORMAT = "imgcal-experiment/1"

# By the key `task`; its default is "rig".
KINDS: dict[str, type[Experiment]] = {
    "rig": RigExperiment,
    "infrared": InfraredExperiment,
    "measurer": MeasurerExperiment,
    "positions": PositionsExperiment,
}

# Order of the keys, as people write them: the subject first.
ORDER = ("format", "name", "description", "paper", "task", "rig", "object", "poses", "drift", "network", "images")

Kind = TypeVar("Kind", bound=Experiment)


@overload
def load_experiment(path: str | Path, changes: Iterable[str] = ()) -> Experiment: ...
@overload
def load_experiment(path: str | Path, changes: Iterable[str] = (), *, kind: type[Kind]) -> Kind: ...
def load_experiment(
    path: str | Path, changes: Iterable[str] = (), *, kind: type[Experiment] = Experiment
) -> Experiment:
    """Read an experiment.

    Args:
        path: a YAML file, or the bare name of a shipped experiment if there is no such file. Files that it names are
            looked up in the current folder, then in its own folder.
        changes: `key.key=value`, values in YAML; the last one wins.
        kind: required kind; `Experiment` = any.

    Raises:
        InputError: one line with the file or the change, the value found and the expected one.

    Examples:
        >>> experiment = load_experiment("table1-row13", ["training.batch_size=8"])
        >>> experiment.task, experiment.network.preset, experiment.training.batch_size
        ('rig', 'vit', 8)
    """
    path = find_file(path, "experiments", ".yaml")
    content = read_yaml_mapping(path, FORMAT)
    content |= {key: _find_file(content[key], path.parent) for key in ("rig", "object") if key in content}
    experiment = change_experiment(parse_experiment(content, str(path)), *changes)
    if not isinstance(experiment, kind):
        names = ", ".join(name for name, one in KINDS.items() if issubclass(one, kind))
        raise InputError(f"{path}: task: found {experiment.task}, expected {names}")
    return experiment


def parse_experiment(content: Mapping[str, Any], where: str) -> Experiment:
    """Validate the plain values of an experiment; errors begin with `where`.

    Raises:
        InputError: one line with the place, the value found and the expected one.
    """
    task = content.get("task", "rig")
    if not isinstance(task, str) or task not in KINDS:
        hint = nearest(str(task), KINDS) or f", expected one of {', '.join(KINDS)}"
        raise InputError(f"{where}: task: found {quote(repr(task))}{hint}")
    return validate(dict(content), KINDS[task], where)


def change_experiment(experiment: Kind, *changes: str) -> Kind:
    """Set values of an experiment: `training.steps=100`, `drift={rotation_deg: 0.5}`; validated after all are set."""
    if not changes:
        return experiment
    content = written_values(experiment)
    for change in changes:
        _apply(content, change)
    return validate(content, type(experiment), f"--set {quote(' '.join(changes))}")


def written_values(experiment: Experiment) -> dict[str, Any]:
    """Plain values of an experiment as given, without defaults where a block records which values were given."""
    return experiment.model_dump(exclude_unset=True)


def resolved_text(experiment: Experiment) -> str:
    """All values, defaults included, as YAML."""
    values = _resolve(experiment)
    return yaml_text({name: values[name] for name in dict.fromkeys((*ORDER, *values)) if name in values})


def save_experiment(experiment: Experiment, path: str | Path) -> None:
    """Write an experiment with all its values, so that it is independent of later changes to defaults."""
    write_text(path, resolved_text(experiment))


def _find_file(name: Any, folder: Path) -> Any:
    """Path of a file that an experiment in `folder` names; the unchanged name if there is no such file."""
    if not isinstance(name, str) or Path(name).exists() or not (folder / name).is_file():
        return name
    return str(folder / name)


def _resolve(model: StrictModel) -> dict[str, Any]:
    """All values except missing ones that are None by default; a None that disables a default is kept."""
    fields = type(model).model_fields
    values = {name: value for name, value in model if value is not None or fields[name].default is not None}
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, StrictModel):
        return _resolve(value)
    if isinstance(value, StrictRecord):
        return {name: _plain(field) for name, field in vars(value).items()}
    return Flow(value) if isinstance(value, list | tuple) else value


def _apply(content: dict[str, Any], change: str) -> None:
    where = f"--set {quote(change)}"
    key, equals, text = change.partition("=")
    steps = key.strip().split(".")
    if not equals or not all(steps):
        raise InputError(f"{where}: found no key and value, expected something like training.steps=100")
    record: Any = content
    for step in steps[:-1]:
        if record.get(step) is None:
            record[step] = {}
        record = record[step]
        if not isinstance(record, dict):
            raise InputError(
                f"{where}: found the value {quote(repr(record))} at `{quote(step)}`, expected a group of keys"
            )
    record[steps[-1]] = parse_yaml(text, where)
