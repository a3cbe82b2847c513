from pathlib import Path

from scripts.benchmarks import alarms
from scripts.benchmarks.alarms import Options, done, go_on, items
from scripts.benchmarks.alarms_runs import Item, run
from scripts.benchmarks.alarms_tables import summarized, tables


def test_a_bump_is_found_and_counted(tmp_path: Path) -> None:
    entry = run(Item("monitor bump", 0))
    assert (entry["wrong"], entry["kind"]) == ([], [True])
    found = summarized([entry])["monitor bump"]
    assert (found["bumps"], found["within_1_s"], found["right_kind"]) == (1, 1, 1)
    assert "100.0 %" in tables({"found": {"monitor bump": found}})["alarms bumps"]


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    path = tmp_path / "items.jsonl"
    path.write_text('{"key": "monitor bump 0"}\n{"key": "monitor bump 0"}\n{"key": "cut o', "utf-8")
    assert [entry["key"] for entry in done(path)] == ["monitor bump 0"]
    assert len({item.key for item in items(1.0)}) == sum(alarms.COUNTS.values())
    assert {item.name for item in items(1.0, ("monitor creep",))} == {"monitor creep"}


def test_only_what_is_left_is_run_and_none_after_the_time_is_over(tmp_path: Path) -> None:
    path, every, asked = tmp_path / "items.jsonl", items(0.001), []

    def mapped(function, some):
        for item in some:
            asked.append(item)
            yield {"key": item.key, "cpu_s": 0.0}

    path.write_text(f'{{"key": "{every[0].key}"}}\n', "utf-8")
    go_on(Options(minutes=0.0, share=0.001, items=path), mapped)
    assert not asked
    go_on(Options(minutes=1.0, share=0.001, items=path), mapped)
    assert asked == every[1:]
    assert {entry["key"] for entry in done(path)} == {item.key for item in every}
