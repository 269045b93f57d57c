"""Running the console scripts, in a process of their own or forked, and the short training that tests share."""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path

SHORT_TRAINING = [
    *("--max-num-iterations", "40", "--steps-per-save", "20", "--vis", "tensorboard"),
    *("--pipeline.model.resolutions", "12", "24", "--pipeline.model.refine-at", "15"),
    *("--pipeline.model.prune-at", "30", "--pipeline.model.thin-at", "35"),
    *("--pipeline.model.view-dependence-from", "25", "--pipeline.datamanager.train-num-rays-per-batch", "512"),
    *("--save-only-latest-checkpoint", "False"),
]
SCREEN = {"COLUMNS": "200", "TERM": "dumb"}
_LOADED = [f"nerfstudio.scripts.{name}" for name in ("train", "eval", "exporter")]
"""What each command imports for ten seconds."""


def one_thread(threads: int = 1) -> dict[str, str]:
    return dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))


def run(*command: str, timeout_s: float = 300.0, threads: int = 1) -> subprocess.CompletedProcess[str]:
    """Run a console script of this environment as a user would, with its output captured as one text."""
    script = Path(sys.executable).with_name(command[0])
    return subprocess.run(
        [str(script), *command[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=timeout_s,
        check=False,
        env={**os.environ, **one_thread(threads), **SCREEN},
    )


def run_forked(*command: str, timeout_s: float = 300.0) -> subprocess.CompletedProcess[str]:
    """The same in a fork of a process that has nerfstudio loaded: for what others of these tests show with `run`."""
    with tempfile.NamedTemporaryFile() as log, started(*command, log=Path(log.name)) as process:
        process.join(timeout_s)
        assert process.exitcode is not None, f"not at its end after {timeout_s} s: {command}"
        return subprocess.CompletedProcess(command, process.exitcode, Path(log.name).read_text())


def succeed(*command: str) -> str:
    """Run a console script in a fork to its end, which has to be a good one; gives what it printed, on one line."""
    result = run_forked(*command)
    assert result.returncode == 0, result.stdout
    return " ".join(result.stdout.split())


def fail(*command: str) -> str:
    """Run a console script in a fork; it has to end with a sentence of ours. Gives what it printed, on one line."""
    result = run_forked(*command)
    assert result.returncode != 0 and "Error: " in result.stdout and "Traceback" not in result.stdout, result.stdout
    return " ".join(result.stdout.split())


@contextmanager
def started(*command: str, log: Path) -> Iterator[ForkServerProcess]:
    """A console script that runs in a fork and writes into `log`; it is killed at the end."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_LOADED)
    before = dict(os.environ)
    os.environ.update(one_thread() | SCREEN)
    try:
        # By path: the package `tests` of another project may be installed.
        process = context.Process(target=runpy.run_path, args=(__file__, {"asked": (command, log)}, "forked"))
        process.start()
    finally:
        os.environ.clear()
        os.environ.update(before)
    try:
        yield process
    finally:
        process.kill()
        process.join()


def _become(command: tuple[str, ...], log: Path) -> None:
    """Do what the console script does; multiprocessing itself prints what is raised, without the hook of the plugin."""
    from thermoxels_ns.nerfstudio_bridge import extend_commands

    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    extend_commands()  # the plugin was loaded before some of the scripts
    script = Path(sys.executable).with_name(command[0])
    sys.argv = [str(script), *command[1:]]
    try:
        runpy.run_path(str(script), run_name="__main__")
    except Exception as problem:
        sys.excepthook(type(problem), problem, problem.__traceback__)
        sys.exit(1)


@dataclass(frozen=True)
class Trained:
    """A scene folder and the run that was trained on it."""

    scene: Path
    run_folder: Path
    log: str
    """What ns-train wrote to its standard output and error, as into a file."""

    @property
    def config(self) -> Path:
        return self.run_folder / "config.yml"

    @property
    def checkpoints(self) -> Path:
        return self.run_folder / "nerfstudio_models"


if __name__ == "forked":
    _become(*globals()["asked"])
