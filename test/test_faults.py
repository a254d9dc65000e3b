"""Runs that are really killed, and disks that are really full: ``make test-faults``."""

from __future__ import annotations

import importlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
import torch
from processes import assert_same_run, contents, record
from torchrl.checkpoint import CheckpointError

from torchrl_ecpo.experiment import Checkpoints, compose_options

pytestmark = pytest.mark.slow

SCRIPTS = Path(__file__).parents[1] / "sota-implementations"
KILLS = {"bandit": 140, "copy": 20, "pendulum": 20, "hopper": 20}
DAMAGES = (
    *("a bit", "a block", "an end", "another checkpoint's file", "a file gone", "a file more"),
)
CONTROL = (
    *("ecac", "log_interval=8", "evaluation.interval=160", "evaluation.episodes=1"),
    *("collector.init_random_frames=80", "hidden_sizes=[16,16]", "replay_buffer.batch_size=16"),
    "loss.num_actor_states=8",
)
RUNS = {
    "bandit": ("ecpo", "env.num_actions=100", "group_size=10", "total_trajectories=2000"),
    "copy": (
        *("ecpo", "env=copy", "policy.hidden_size=8", "num_groups=2", "group_size=5"),
        *("project_steps=2", "total_trajectories=2000", "evaluation.interval=20"),
    ),
    "pendulum": (*CONTROL, "env=pendulum", "total_frames=800"),
    "hopper": (*CONTROL, "env=hopper", "total_frames=800"),
}


@cache
def composed(script, *options):
    """The configuration of a script that writes a checkpoint wherever it may."""
    often = ("checkpoint.interval=0", "checkpoint.max_share=1", "resume=auto")
    return compose_options(SCRIPTS / script, [*often, *options])


def fork(directory, script, *options):
    """Start a script in a process of its own, in a directory; return the process id."""
    directory.mkdir(exist_ok=True)
    config = composed(script, *options)
    process = os.fork()
    if process:
        return process
    try:
        os.chdir(directory)
        log = os.open("log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        sys.stdout = sys.stderr = os.fdopen(log, "w", buffering=1)
        torch.set_num_threads(1)
        sys.path.insert(0, str(SCRIPTS / script))
        importlib.import_module(script).main.__wrapped__(config)
        code = 0
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    os._exit(code)


def finish(directory, *run):
    """Run to the end; return the exit status and what was printed."""
    _, status = os.waitpid(fork(directory, *run), 0)
    return os.waitstatus_to_exitcode(status), (directory / "log").read_text()


def number_of_rows(directory):
    path = directory / "metrics.csv"
    return path.read_bytes().count(b"\n") - 1 if path.exists() else 0


@pytest.mark.parametrize("name", RUNS)
def test_killed_at_random_moments(tmp_path, capsys, name):
    run, whole, killed = RUNS[name], tmp_path / "whole", tmp_path / "killed"
    if name == "bandit":
        run = (*run, "checkpoint.keep=1")
    code, output = finish(whole, *run)
    assert code == 0, output
    rows = len(record(whole))
    generator = random.Random(name)
    within_writes = 0
    for moment in sorted(generator.sample(range(rows - 5), KILLS[name])):
        process = fork(killed, *run)
        if generator.random() < 0.2:  # while it begins, or resumes
            time.sleep(generator.uniform(0.0, 1.0))
        else:
            while number_of_rows(killed) < moment:
                time.sleep(0.005)
                assert os.waitpid(process, os.WNOHANG)[0] == 0, (killed / "log").read_text()
            time.sleep(generator.uniform(0.0, 0.02))
        os.kill(process, signal.SIGKILL)
        assert os.WTERMSIG(os.waitpid(process, 0)[1]) == signal.SIGKILL
        within_writes += any((killed / "checkpoints").glob(".*checkpoint-*"))
    code, output = finish(killed, *run)
    assert code == 0, output
    assert "Resumed from" in output
    assert_same_run(killed, whole)
    assert within_writes >= 1
    with capsys.disabled():
        print(
            f"\n{name}: {KILLS[name]} times killed, {within_writes} of them within a checkpoint's "
            f"writing; all {rows} rows and the final weights equal the run's that was not killed"
        )


def spoil(path, other, generator):
    """Damage a checkpoint; return how, and which file of it."""
    files = [file for file in sorted(path.rglob("*")) if file.is_file()]
    kind = generator.choice(DAMAGES)
    if kind == "another checkpoint's file":
        files = [f for f in files if f.read_bytes() != (other / f.relative_to(path)).read_bytes()]
    file = generator.choice(files)
    content = bytearray(file.read_bytes())
    at = generator.randrange(len(content))
    if kind == "a bit":
        content[at] ^= 1 << generator.randrange(8)
    elif kind == "a block":
        content[at : at + 512] = bytes(255 - byte for byte in content[at : at + 512])
    elif kind == "an end":
        del content[at:]
    elif kind == "another checkpoint's file":
        content = (other / file.relative_to(path)).read_bytes()
    if kind == "a file gone":
        file.unlink()
    elif kind == "a file more":
        file = file.with_name(file.name + ".more")
        file.touch()
    else:
        file.write_bytes(content)
    is_other_manifest = kind == "another checkpoint's file" and file.parent == path
    return kind, "state.pt" if is_other_manifest else file.relative_to(path).as_posix()


def test_a_hundred_damages(tmp_path, capsys):
    run, source, copy = RUNS["pendulum"], tmp_path / "run", tmp_path / "copy"
    process = fork(source, *run)
    while number_of_rows(source) < 20:
        time.sleep(0.005)
        assert os.waitpid(process, os.WNOHANG)[0] == 0, (source / "log").read_text()
    os.kill(process, signal.SIGTERM)
    os.waitpid(process, 0)
    config = composed(*run)
    whole = Checkpoints(config, source)
    generator, found = random.Random(0), Counter()
    for _ in range(100):
        shutil.copytree(source, copy)
        older, newest = sorted((copy / "checkpoints").iterdir())
        assert newest.name == whole.source.name
        kind, name = spoil(newest, older, generator)
        before = contents(copy)
        with pytest.raises(CheckpointError, match=re.escape(name)):
            Checkpoints(config, copy)
        assert contents(copy) == before
        found[kind] += 1
        shutil.rmtree(copy)
    with capsys.disabled():
        print(f"\n100 damages, each refused by the name of the file: {dict(found)}")


def test_a_disk_that_is_full(tmp_path, capsys):
    run, disk = RUNS["pendulum"], tmp_path / "disk"
    disk.mkdir()
    if subprocess.call(["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", str(disk)]):
        pytest.skip("a small disk can be made by root alone")
    try:
        code, output = finish(disk, *run)
        assert code != 0
        assert "could not be written" in output or "No space left on device" in output, output
        (*_, last) = output.strip().splitlines()
        subprocess.check_call(["mount", "-o", "remount,size=10m", str(disk)])
        code, output = finish(disk, *run)
        assert code == 0, output
        assert "Resumed from" in output
        assert finish(tmp_path / "whole", *run)[0] == 0
        assert_same_run(disk, tmp_path / "whole")
    finally:
        subprocess.check_call(["umount", str(disk)])
    with capsys.disabled():
        print(f"\nfull disk: the run ended with {last!r} and was resumed on a larger one")


def worker_processes(parent):
    """The processes that a process has spawned to collect."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    commands = {int(child): Path(f"/proc/{child}/cmdline").read_text() for child in children}
    return [child for child, command in commands.items() if "spawn_main" in command]


@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
@pytest.mark.parametrize("name", ["copy", "pendulum"])
def test_a_worker_process_that_is_killed(tmp_path, capsys, name, kind):
    script, *options = RUNS[name]
    command = [
        *(sys.executable, str(SCRIPTS / script / f"{script}.py"), *options),
        *(f"collector={kind}", "resume=auto", f"hydra.run.dir={tmp_path}", "checkpoint.interval=0"),
        "checkpoint.max_share=1",
    ]
    generator = random.Random(name + kind)
    process = subprocess.Popen(command, stdout=-1, stderr=subprocess.STDOUT, text=True)
    try:
        while number_of_rows(tmp_path) < 3:
            time.sleep(0.05)
            assert process.poll() is None, process.communicate()[0]
        time.sleep(generator.uniform(0.0, 0.2))
        worker = generator.randrange(2)
        os.kill(worker_processes(process.pid)[worker], signal.SIGKILL)
        killed_at = time.monotonic()
        output, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    waited = time.monotonic() - killed_at
    assert process.returncode != 0
    assert f"ChildProcessError: Worker {worker} of the collector was killed by SIGKILL" in output
    assert "resume=auto" in output
    last = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert last.returncode == 0, last.stderr
    assert "Resumed from" in last.stdout
    steps = [int(row["step"]) for row in record(tmp_path)]
    assert steps == sorted(set(steps))
    with capsys.disabled():
        print(
            f"\n{name}, collector={kind}: a worker killed; the run ended with a message after "
            f"{waited:.1f} s, and was resumed"
        )
