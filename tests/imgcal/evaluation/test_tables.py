import json
from dataclasses import replace

import pytest
import torch

from imgcal.evaluation import (
    EncoderCheck,
    Evaluation,
    Facts,
    Latency,
    Method,
    Protocol,
    Row,
    Scores,
    Summary,
    as_tables,
    describe,
    evaluate,
    markdown,
    network_method,
    sweep,
    write,
)
from imgcal.evaluation.methods import keep_factory_rig
from imgcal.evaluation.plots import draw_latency, draw_sweep, draw_training
from imgcal.evaluation.tables import Table, as_values
from tests.imgcal.evaluation.conftest import Fake, straight_down

HISTORY = ({"step": 10, "re_px": 9.0}, {"step": 20, "re_px": 5.0, "validation_re_px": 6.0})


@pytest.fixture(scope="module")
def summary(conditions) -> Summary:
    known = straight_down(conditions(kappa=0.002, noise=0.1))
    methods = {"fake": network_method(Fake(known)), "factory": Method(keep_factory_rig)}
    few = Protocol(count=4, trials=2)
    return Summary(
        evaluate(methods, known, few),
        {"fake": Latency(1.0, 2.0, 3.0, 4.0), "factory": Latency(5.0, 6.0, None, None)},
        {"fake": Facts(1234, 5_600_000, HISTORY)},
        (sweep(methods, known, "noise", replace(few, trials=1), (0.0, 0.1)),),
    )


def test_values_are_json_with_both_columns(summary):
    values = json.loads(json.dumps(as_values(summary), allow_nan=False))
    assert values["format"] == "imgcal-evaluation/1"
    assert values["rig"] == "T4"
    assert values["corruption"]["noise"] == 0.1
    assert values["poses_deg"]["phi"] == [0.0, 0.0]
    fake = values["methods"]["fake"]
    assert fake["refined"]["re_px"]["mean"] < fake["alone"]["re_px"]["mean"]
    assert fake["refined"]["cramer_rao_ratio"]["re"] > 0
    assert fake["latency_ms"]["refined_p50"] == 3.0
    assert (fake["model"]["parameters"], fake["model"]["bytes"]) == (1234, 5_600_000)
    assert fake["passes"] == 2 and fake["one_pass"]["re_px"] == fake["alone"]["re_px"]
    assert 0 < fake["refined"]["held_out_px"]["median"] < fake["alone"]["held_out_px"]["median"]
    assert values["methods"]["factory"]["refined"] is None
    assert values["methods"]["factory"]["model"] is None
    assert values["sweeps"]["noise"]["values"] == [0.0, 0.1]
    assert len(values["sweeps"]["noise"]["methods"]["fake"]["refined"]) == 2


def test_what_is_not_finite_is_null(summary):
    row = summary.evaluation.rows["factory"]
    broken = replace(row.alone.trials[0], re=torch.full((4,), torch.inf, dtype=torch.float64))
    evaluation = replace(summary.evaluation, rows={"factory": Row(Scores((broken,), ()))})
    values = as_values(Summary(evaluation))
    assert values["methods"]["factory"]["alone"]["re_px"]["mean"] is None
    assert "> 10000" in markdown(Summary(evaluation))


def test_tables_show_every_method_and_the_reference(summary):
    errors, parameters, cost = as_tables(summary)
    names = ["fake, one pass", "fake, 2 passes", "fake, refined", "factory", "MAP, true inliers"]
    assert [row[0] for row in errors.rows] == [row[0] for row in parameters.rows] == names
    assert [row[1] for row in errors.rows] == ["one seed"] * 3 + ["–"] * 2
    assert cost.rows[0][-2:] == ("1,234", "5.6")
    assert cost.rows[1][3:] == ("–", "–", "–", "–")
    assert errors.rich().row_count == 5


def test_training_seeds_of_one_experiment_share_a_line(conditions):
    known = straight_down(conditions(kappa=0.002))
    methods = {name: network_method(Fake(known)) for name in ("a", "b", "other")}
    evaluation = evaluate(methods, known, Protocol(count=4, trials=1))
    worse = evaluation.rows["b"]
    trial = worse.alone.trials[0]
    worse = replace(worse, alone=Scores((replace(trial, re=3 * trial.re),), ()))
    evaluation = replace(evaluation, rows=evaluation.rows | {"b": worse})
    facts = {name: Facts(1, 1, (), "same", seed) for seed, name in enumerate("ab")}
    summary = Summary(evaluation, facts=facts | {"other": Facts(1, 1, (), "other", 0)})
    rows = {row[0]: row for row in as_tables(summary)[0].rows}
    assert list(rows)[:3] == ["same, one pass", "same, 2 passes", "same, refined"] and "a, one pass" not in rows
    mean = float(trial.re.mean())  # of seeds once and three times as large: mean 2, standard deviation root 2
    assert rows["same, 2 passes"][1:3] == ("2 seeds", f"{2 * mean:.3g} ± {2**0.5 * mean:.3g}")
    assert rows["other, 2 passes"][1] == "one seed" and "±" not in rows["other, 2 passes"][2]
    assert as_values(summary)["seeds"] == {"same": ["a", "b"]}
    again = Summary(evaluation, facts={name: replace(fact, seed=1) for name, fact in facts.items()})
    assert all("seeds" not in row[1] for row in as_tables(again)[0].rows)  # the same seed twice says nothing of others


def test_an_encoder_that_is_not_used_is_named(summary):
    checks = {"fake": EncoderCheck(1.0, 1.0, 5.0, 5.0), "good": EncoderCheck(0.5, 50.0, 60.0, 70.0)}
    known = replace(summary, facts={name: Facts(1, 1, encoder=check) for name, check in checks.items()})
    [table] = [table for table in as_tables(known) if "spoilt" in table.title]
    assert [row[-2:] for row in table.rows] == [("1 x", "NOT USED"), ("100 x", "used")]
    assert as_values(known)["methods"]["fake"]["model"]["encoder"]["used"] is False


def test_markdown_is_a_table():
    lines = Table("Title", ("method", "a"), (("x", "1"), ("longer", "22"))).markdown().splitlines()
    assert lines == ["### Title", "", "| method |  a |", "| :----- | -: |", "| x      |  1 |", "| longer | 22 |"]


def test_the_description_says_what_the_rigs_were(summary):
    text = describe(summary.evaluation)
    assert "Rig T4, object asymmetric8, phi 0 to 0 deg" in text
    assert "noise 0.1" in text
    exact: Evaluation = replace(
        summary.evaluation,
        conditions=replace(summary.evaluation.conditions, corruption=type(summary.evaluation.conditions.corruption)()),
    )
    assert "exact points" in describe(exact)


def test_files_are_written(summary, tmp_path):
    files = write(summary, tmp_path)
    expected = ["evaluation.json", "evaluation.md", "error-noise.png", "training.png", "latency.png"]
    assert [path.name for path in files] == expected
    assert {path.name for path in tmp_path.iterdir()} == set(expected)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files[2:])
    assert json.loads(files[0].read_text())["trials"] == 2


def test_only_what_there_are_data_for_is_drawn(summary, tmp_path):
    assert [path.suffix for path in write(Summary(summary.evaluation), tmp_path)] == [".json", ".md"]


def test_plots_show_what_was_measured(summary):
    [axes] = draw_sweep(summary.sweeps[0]).axes
    assert [line.get_label() for line in axes.lines] == ["fake", "fake, refined", "factory", "MAP, true inliers"]
    assert list(axes.lines[0].get_xdata()) == [0.0, 0.1]
    [axes] = draw_training(summary).axes
    assert [list(line.get_xdata()) for line in axes.lines] == [[10, 20], [20]]
    assert list(axes.lines[1].get_ydata()) == [6.0]
    [axes] = draw_latency(summary).axes
    assert {line.get_label() for line in axes.lines if not line.get_label().startswith("_")} == {
        "fake",
        "fake, refined",
        "factory",
    }
