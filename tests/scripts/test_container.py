"""The container's files, as far as they can be tried where nothing builds images."""

import json
import re
import runpy
import shlex
import socket
from pathlib import Path

import numba
import pytest
import yaml

from imgcal import load_object, load_rig
from imgcal.cli.main import parse
from imgcal.live_page import LivePage, parse_address
from scripts.container import steps
from tests.imgcal.compile_listener import LISTEN

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "scripts" / "container"


def instructions():
    """Every instruction of the Dockerfile: (stage, keyword, rest)."""
    text = re.sub(r"\\\n\s*", "", (FOLDER / "Dockerfile").read_text())
    found, stage = [], ""
    for line in text.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        keyword, rest = line.split(maxsplit=1)
        stage = rest if keyword == "FROM" else stage
        found.append((stage, keyword, rest))
    return found


def of(keyword):
    return [rest for _, found, rest in instructions() if found == keyword]


def test_all_that_is_copied_is_there_and_sent_to_the_builder():
    sent = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    copied = [part for rest in of("COPY") if not rest.startswith("--from") for part in rest.split()[:-1]]
    assert {"imgcal", "renderers", "data", "pyproject.toml"} <= set(copied)
    for part in copied:
        assert (ROOT / part).exists() and any(part == one or part.startswith(f"{one}/") for one in sent), part


def test_extras_that_are_installed_exist():
    (installed,) = [rest for rest in of("RUN") if "/source[" in rest]
    extras = re.search(r"/source\[([\w,]+)\]", installed)[1].split(",")
    declared = (ROOT / "pyproject.toml").read_text()
    assert extras and all(re.search(rf"^{extra} = \[", declared, re.M) for extra in extras)


def test_commands_are_understood():
    commands = [shlex.split(rest)[1:] for rest in of("RUN") if rest.startswith("imgcal ")]
    assert json.loads(of("ENTRYPOINT")[0]) == ["imgcal"] and commands == [["warmup"]]
    services = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]
    for command in [*commands, json.loads(of("CMD")[0]), services["watch"]["command"]]:
        assert type(parse(command)).__name__.lower() == command[0]
    watch, rig = services["watch"]["command"], services["rig"]
    built = {"context": "../..", "dockerfile": "scripts/container/Dockerfile"}
    assert services["watch"]["build"] == rig["build"] == built and (ROOT / built["dockerfile"]).is_file()
    assert rig["command"] == ["tcp://0.0.0.0:5555"] and watch[1] == "tcp://rig:5555"
    program = [part for part in of("COPY") if part.endswith(rig["entrypoint"][1])]
    assert program == [f"scripts/examples/send_blobs.py {rig['entrypoint'][1]}"]
    exposed = of("EXPOSE")[0].split()
    assert all(any(port.split(":")[1] == one for port in services["watch"]["ports"]) for one in exposed)


def test_it_runs_without_rights_and_writes_where_it_may():
    final = [(keyword, rest) for stage, keyword, rest in instructions() if stage == of("FROM")[-1]]
    after = [keyword for keyword, _ in final[final.index(("USER", "imgcal")) :]]
    assert "RUN" in after and after.count("USER") == 1 and "COPY" not in after  # what is warmed belongs to that user
    (made,) = [rest for keyword, rest in final if keyword == "RUN" and "useradd" in rest]
    (environment,) = of("ENV")
    cache = re.search(r"NUMBA_CACHE_DIR=(\S+)", environment)[1]
    assert cache in made and of("WORKDIR") == of("VOLUME") == ["/data"] and "/data" in made.split()


def test_code_is_compiled_for_processors_that_numba_knows():
    names = dict(part.split("=", 1) for rest in of("ARG") for part in [rest])
    features = names["CPU_FEATURES"].split(",")
    assert names["CPU"].startswith("x86-64-v") and all(feature.startswith("+") for feature in features)
    assert all(hasattr(numba.config, name) for name in ("CPU_NAME", "CPU_FEATURES", "CACHE_DIR"))


@pytest.mark.parametrize("address", ["127.0.0.1:0", "0.0.0.0:0"])
def test_health_is_whether_the_page_answers(address):
    answers = runpy.run_path(str(FOLDER / "health.py"))["answers"]
    pytest.importorskip("uvicorn")
    (checked,) = of("HEALTHCHECK")
    assert json.loads(checked[checked.index("[") :]) == ["python", "/opt/imgcal/health.py", "8765"]
    with LivePage(load_rig("T4"), load_object("cube8"), parse_address(address)) as page:
        assert answers(page.address.port, seconds=60.0)  # on a machine that is compiling for other tests
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert not answers(port)


USE = (
    LISTEN
    + """
import json, sys

known = ["--rig", sys.argv[1] + "/rig.yaml", "--object", sys.argv[1] + "/object.csv"]
assert main(["simulate", *known, "--snapshots", "1", "--out", "simulated"]) == 0
print(json.dumps(Compiled.names))
"""
)
PROJECTION_ALONE = """

def warm_up(all_lenses: bool = False) -> None:
    simulate_truth(read_rig(RIG), load_object(OBJECT), 1, _make_generator(), DRIFT)
"""


def installed_files(folder):
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in found if "__pycache__" not in path.parts}


@pytest.mark.slow
def test_the_image_is_built_keeps_what_it_compiles_and_its_page_answers(capfd, monkeypatch):
    """Copying, building, installing, compiling, starting, health: all but the base image and pip's downloads.

    `imgcal warmup` compiles the projection only: all it compiles is in tests/imgcal/online/test_warmup.py.
    """
    run_step = steps.Image.step

    def step(image, keyword, rest):
        if (keyword, rest) == ("RUN", "imgcal warmup"):
            (file,) = image.root.glob("opt/imgcal/lib/python*/site-packages/imgcal/online/warmup.py")
            file.write_text(file.read_text() + PROJECTION_ALONE)
        run_step(image, keyword, rest)

    monkeypatch.setattr(steps.Image, "step", step)
    with steps.build() as image:
        told = capfd.readouterr()
        assert "RUN imgcal warmup" in told.out
        assert "imgcal: compiling for this machine, which takes a few minutes" in told.err.splitlines()
        assert re.search(rf"\d+ functions compiled in .* s, kept in {image.root}/var/cache/imgcal\n", told.err)
        (packages,) = image.root.glob("opt/imgcal/lib/python*/site-packages")
        for package in ("imgcal", "renderers"):
            assert installed_files(ROOT / package) <= installed_files(packages / package)
        image.start()
        assert ": healthy\n" in capfd.readouterr().out
        sample = packages / "imgcal" / "data" / "samples" / "O10"
        done = image.run(["python", "-c", USE, sample], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout.splitlines()[-1]) == [] and "imgcal: compiling" not in done.stderr
