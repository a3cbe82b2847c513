"""Run the Dockerfile's steps on a machine that cannot build images: `python scripts/container/steps.py`.

A folder stands for the image's root. Copy what .dockerignore lets through, build and install the package, compile loops
as the unprivileged user (if possible), start the image's command, and run its health check until it succeeds. All other
packages are those of this environment: downloads by pip and the base image itself are not tested.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

TOP = Path(__file__).resolve().parents[2]
DOCKERFILE = Path(__file__).with_name("Dockerfile")
ROOTS = re.compile(r"(?<![\w./-])/(opt|var|data|source)\b")  # folders of the image
UID = 10001
HEALTHY_WITHIN = 180.0  # s


def main() -> None:
    """Run every step; on failure, exit with that step's exit code."""
    with build() as image:
        image.start()
    print("all steps run, and the page answers")


@contextlib.contextmanager
def build() -> Iterator[Image]:
    """Run every instruction of the Dockerfile, in a folder that is removed at the end."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        image = Image(Path(folder))
        for keyword, rest in instructions(DOCKERFILE.read_text()):
            began = time.monotonic()
            image.step(keyword, rest)
            print(f"{time.monotonic() - began:6.1f} s  {keyword} {rest[:100]}", flush=True)
        yield image


def instructions(text: str) -> Iterator[tuple[str, str]]:
    """Yield the keyword and the rest of each instruction."""
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if line.strip() and not line.startswith("#"):
            keyword, rest = line.split(maxsplit=1)
            yield keyword, rest


@dataclass
class Image:
    """Folder that stands for the root of an image."""

    root: Path
    environment: dict[str, str] = field(default_factory=lambda: {"LANG": "C.UTF-8"} | _passed_on())
    values: dict[str, str] = field(default_factory=dict)  # of ARG
    user: int | None = None
    start_with: dict[str, list[str]] = field(default_factory=dict)  # ENTRYPOINT, CMD, HEALTHCHECK

    def step(self, keyword: str, rest: str) -> None:
        """Execute an instruction."""
        match keyword:
            case "ARG":
                name, _, value = rest.partition("=")
                self.values[name] = value
            case "ENV":
                for pair in shlex.split(self._with_values(rest)):
                    name, _, value = pair.partition("=")
                    self.environment[name] = self._inside(value)
            case "COPY" if not rest.startswith("--from"):
                *sources, target = rest.split()
                for source in sources:
                    self._copy(source, self.root / target.lstrip("/"), target.endswith("/"))
            case "RUN":
                self._run(self._with_values(rest))
            case "USER":
                self.user = UID if self._may_run_as(UID) else None
            case "ENTRYPOINT" | "CMD" | "HEALTHCHECK":
                self.start_with[keyword] = json.loads(rest[rest.index("[") :])

    def start(self) -> None:
        """Start the image's command, and run its health check until it succeeds.

        Raises:
            SystemExit: it never succeeds.
        """
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = str(free.getsockname()[1])
        command = [part.replace("8765", port) for part in (*self.start_with["ENTRYPOINT"], *self.start_with["CMD"])]
        check = [self._inside(part).replace("8765", port) for part in self.start_with["HEALTHCHECK"]]
        began = time.monotonic()
        with subprocess.Popen(self._found(command), cwd=self.root / "data", **self._as_user()) as process:
            try:
                while self.run(check).returncode:
                    if process.poll() is not None or time.monotonic() - began > HEALTHY_WITHIN:
                        raise SystemExit(f"{shlex.join(command)}: never healthy, exit code {process.poll()}")
                    time.sleep(0.5)
                print(f"{time.monotonic() - began:6.1f} s  {shlex.join(command)}: healthy", flush=True)
                process.terminate()
                process.wait(timeout=30)
            finally:
                process.kill()

    def run(self, command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
        """Run a command in the image as its user, whatever it returns."""
        return subprocess.run(self._found(command), cwd=self.root / "data", check=False, **self._as_user(), **options)

    def _copy(self, source: str, target: Path, is_folder: bool) -> None:
        """Copy what .dockerignore sends to the builder."""
        sent = [line[1:] for line in (TOP / ".dockerignore").read_text().splitlines() if line.startswith("!")]
        if not any(source == one or source.startswith(f"{one}/") for one in sent):
            raise SystemExit(f"COPY {source}: excluded by .dockerignore")
        if (TOP / source).is_dir():
            shutil.copytree(TOP / source, target, ignore=shutil.ignore_patterns("__pycache__"))
            return
        target = target / Path(source).name if is_folder else target
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(TOP / source, target)

    def _run(self, command: str) -> None:
        """Run a command in the image; `pip install` uses the packages of this environment."""
        python = self.root / "opt" / "imgcal" / "bin" / "python"
        if "-m venv" in command:
            subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(python.parents[1])], check=True)
            (packages,) = python.parents[1].glob("lib/python*/site-packages")
            (packages / "environment.pth").write_text(sysconfig.get_path("purelib") + "\n")
        elif "pip install" in command:
            if "/source" in command:
                install = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps"]
                subprocess.run([sys.executable, *install, str(self.root / "source")], check=True)
        else:
            command = re.sub(r"useradd [^&]*&& ", "", command)
            owner = f"-o {UID} -g {UID} " if os.geteuid() == 0 else ""
            asked = self._inside(command.replace("-o imgcal -g imgcal ", owner))
            subprocess.run(["sh", "-c", asked], check=True, **self._as_user())

    def _may_run_as(self, user: int) -> bool:
        """Tell whether commands can run as an unprivileged user who can read this Python."""
        if os.geteuid() != 0:
            return False
        python = [str(self.root / "opt" / "imgcal" / "bin" / "python"), "-c", "import torch"]
        try:
            done = subprocess.run(python, user=user, group=user, extra_groups=[], capture_output=True, check=False)
        except OSError:
            done = None
        if done is None or done.returncode:
            print("        note: other users cannot read this Python, so everything runs as root", flush=True)
            return False
        return True

    def _as_user(self) -> dict[str, Any]:
        environment = self.environment | {"HOME": str(self.root / "data")}
        if self.user is None:
            return {"env": environment}
        return {"env": environment, "user": self.user, "group": self.user, "extra_groups": []}

    def _found(self, command: Sequence[str]) -> list[str]:
        """Resolve a command's program in the image's PATH."""
        program = shutil.which(command[0], path=self.environment["PATH"])
        return [program or command[0], *command[1:]]

    def _with_values(self, text: str) -> str:
        """Substitute ARG and ENV values for $NAME."""
        known = self.values | self.environment
        return re.sub(r"\$(\w+)", lambda match: known.get(match[1], match[0]), text)

    def _inside(self, text: str) -> str:
        """Translate the image's paths into paths of the folder."""
        return ROOTS.sub(lambda match: f"{self.root}/{match[1]}", text)


def _passed_on() -> dict[str, str]:
    """Variables of this environment that the image has too."""
    return {name: os.environ[name] for name in ("PATH", "OMP_NUM_THREADS") if name in os.environ}


if __name__ == "__main__":
    main()
