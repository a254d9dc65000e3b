"""Each benchmark runs to its end, and writes the columns of the committed table."""

from __future__ import annotations

from pathlib import Path

import pytest
from processes import run_script

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
# The shortest run of each. sbx_loop.py brings JAX, and has an environment of its own.
SHORTEST = {
    "actor_critic": "--repeats 1",
    "compile": "--repeats 1 --losses ecac",
    "environments": "--repeats 1 --copies 2 --steps 5",
    "groups": "--turns 1",
    "growth": "--repeats 1",
    "llm_lengths": "",
    "llm_memory": "--repeats 1",
    "loop": "--repeats 1 --levels 2",
    "moments": "",
    "parts": "--repeats 1",
    "recurrent": "--repeats 1 --steps 10 --branch 0.05",
    "sampler": "--repeats 1 --sizes 1e4",
    "stacked": "--repeats 1 --runs 1 --levels 2",
}
NEEDS = {
    "actor_critic": "stable_baselines3",
    "compile": "mujoco",
    "groups": "minigrid",
    "growth": "mujoco",
    "llm_memory": "transformers",
    "parts": "mujoco",
}


def test_all_are_listed() -> None:
    scripts = {path.stem for path in BENCHMARKS.glob("*.py")}
    assert scripts == {*SHORTEST, "common", "sbx_loop"}


def test_a_count_of_none_is_refused(tmp_path: Path) -> None:
    result = run_script(tmp_path, BENCHMARKS / "sampler.py", "--repeats", "0")
    assert result.returncode == 2
    assert "--repeats must be at least 1, got 0" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORTEST)
def test_benchmark(name: str, tmp_path: Path) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    table = tmp_path / "table.csv"
    options = [*SHORTEST[name].split(), "--csv", str(table)]
    result = run_script(tmp_path, BENCHMARKS / f"{name}.py", *options, afresh=True)
    assert result.returncode == 0, result.stderr[-2000:]
    committed = BENCHMARKS / "results" / f"{name}.csv"
    columns, known = (path.read_text().splitlines()[0] for path in (table, committed))
    assert columns == known
