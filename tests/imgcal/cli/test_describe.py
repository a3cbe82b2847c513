from imgcal.cli.describe import table
from imgcal.cli.main import main
from imgcal.io import Key, list_keys
from imgcal.networks import PRESETS
from imgcal.training import KINDS, load_experiment


def test_every_key_has_a_meaning() -> None:
    records = [*KINDS.values(), *dict.fromkeys(type(variant) for variant in PRESETS.values())]
    silent = [f"{record.__name__}: {key.path}" for record in records for key in list_keys(record) if not key.meaning]
    assert not silent, silent


def test_all_that_a_shipped_experiment_says_is_listed(capsys) -> None:
    assert main(["describe", "experiments"]) == 0
    listed = {line.split()[0].rstrip(":") for line in capsys.readouterr().out.splitlines() if line.startswith("  ")}

    def paths(content, prefix=""):
        for name, value in content.items():
            inner = isinstance(value, dict) and value and prefix + name not in ("network.change",)
            yield from paths(value, f"{prefix}{name}.") if inner else [prefix + name]

    for name in ("table1-row13-paper", "shipped-points-cube8"):
        written = load_experiment(name).model_dump(mode="json", exclude_unset=True)
        assert set(paths(written)) <= listed


def test_what_does_not_fit_goes_on_below() -> None:
    keys = [Key("a.b", "integer", "3", "word " * 40), Key("c", "text", "", "")]
    [head, empty, *lines] = table("head", keys).splitlines()
    assert (head, empty) == ("head", "") and lines[0].startswith("  a.b: 3  integer. word")
    assert lines[1].startswith(" " * 10 + "word") and max(map(len, lines)) <= 120
    assert lines[-1] == "  c:      text"
