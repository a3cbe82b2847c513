"""Every option of every command has a help text."""

import re

import pytest

from imgcal.cli.main import COMMANDS, main

ADDED = re.compile(r"\((default: .*|required|optional|sets: .*|repeatable)\)")


def helped(capsys, monkeypatch, *command):
    """The boxes of a command's help by title: rows of text."""
    monkeypatch.setenv("COLUMNS", "100")
    assert main([*command, "--help"]) == 0
    boxes, rows, before = {}, [], ""
    for line in capsys.readouterr().out.splitlines():
        if set(line.strip()) == {"-"}:  # under the title; where nobody looks, a frame is of blanks
            rows = boxes.setdefault(before, [])
        elif line.startswith("  ") and line.strip():
            rows.append(line[2:].rstrip())
        before = line.strip()
    return boxes


def sentences(title, rows):
    """What is said of each option: an entry begins at the margin, its words stand behind a gap or in the rows below."""
    said, name = {}, None
    for row in rows:
        if not row.startswith(" "):
            name, _, row = row.partition("  ")
            if not (name.startswith("-") or title == "positional arguments"):
                name = None  # of the group
        if name is not None:
            said[name] = f"{said.get(name, '')} {row.strip()}"
    return {name: ADDED.sub("", text).strip() for name, text in said.items()}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_has_a_sentence(command, capsys, monkeypatch):
    pages = {(command,): helped(capsys, monkeypatch, command)}
    for row in pages[command,].pop("subcommands", []):
        if found := re.match(r" +• ([a-z-]+) ", row):
            pages[command, found[1]] = helped(capsys, monkeypatch, command, found[1])
    for page, boxes in pages.items():
        said = {name: text for box in boxes.items() for name, text in sentences(*box).items()}
        assert "-h, --help" in said
        assert [" ".join(page) + " " + name for name, text in said.items() if not re.search("[a-z]", text)] == []


def test_sentences_are_not_broken_where_the_source_is(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    assert main(["calibrate", "--help"]) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if "without a factory calibration" in line)
    assert "field of view (imgcal rig cameras writes one)" in row and "defines the rig's frame (default: None)" in row


def test_examples_have_lines_of_their_own(capsys):
    for command in COMMANDS:
        main([command, "--help"])
        rows = [line.strip() for line in capsys.readouterr().out.splitlines()]
        first = {"rig": "See imgcal rig look-at", "warmup": "RUN imgcal warmup"}.get(command, f"imgcal {command} ")
        assert any(row.startswith(first) for row in rows), command


def test_a_missing_sentence_would_be_noticed():
    rows = ["of a group", "--level {None}|INT  (default: None)", "--long INT", "       (required)", "-x  of x (1)"]
    assert sentences("options", rows) == {"--level {None}|INT": "", "--long INT": "", "-x": "of x (1)"}
    assert sentences("positional arguments", ["PATH", "     which"]) == {"PATH": "which"}
