"""Stacked runs are the runs that they would be alone."""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.envs import InitTracker, TransformedEnv

from torchrl_ecpo.envs import AlgorithmicEnv
from torchrl_ecpo.experiment import Checkpoints, Run, read_metrics
from torchrl_ecpo.modules import TupleCategorical, make_softmax_policy, make_tuple_policy
from torchrl_ecpo.modules.histories import distinct_histories, hash_histories

SCRIPT = Path(__file__).parents[1] / "sota-implementations/ecpo"
MODULES = ("utils", "tasks", "stacked", "ecpo")
BANDIT = ("env=bandit", "env.num_actions=50", "group_size=10", "total_trajectories=1000")
COPY = (
    *("env=copy", "env.hidden_size=16", "num_groups=4", "group_size=5", "evaluation_interval=40"),
    *("total_trajectories=2000", "optim.max_grad_norm=0.5", "project_steps=2"),
    "anneal_from={metric:return,at_least:0.1}",
)
SEEDS = (3, 11)


@pytest.fixture
def script(monkeypatch):
    """The folder of the script, as if it were started from there."""
    monkeypatch.syspath_prepend(str(SCRIPT))
    yield importlib.import_module
    for name in [name for name in sys.modules if name.split(".")[0] in MODULES]:
        del sys.modules[name]


@pytest.fixture
def train(script, monkeypatch):
    """Runs the script in this process, in a directory; until SIGTERM if `stop_at` says when."""
    monkeypatch.setattr("torchrl_ecpo.experiment.run.plot_learning_curve", lambda *_, **__: "")
    main = script("ecpo").main
    boundary = Checkpoints.boundary

    def train(directory, *options, stop_at=None):
        def stop(checkpoints):
            if checkpoints.step == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            boundary(checkpoints)

        directory.mkdir(exist_ok=True)
        monkeypatch.chdir(directory)
        monkeypatch.setattr(Checkpoints, "boundary", stop)
        options = ["checkpoint.interval=null", *options]
        with initialize_config_dir(str(SCRIPT / "config"), version_base="1.3"):
            HydraConfig.instance().set_config(compose("config", options, return_hydra_config=True))
            main.__wrapped__(compose("config", options))

    yield train
    HydraConfig.instance().cfg = None


def assert_same_curves(actual, expected):
    """Equal to float tolerance; what was sampled is equal altogether."""
    actual, expected = read_metrics(actual), read_metrics(expected)
    assert actual.keys() == expected.keys()
    for name, column in expected.items():
        tolerance = {"abs": 1e-5, "rel": 1e-4, "nan_ok": True}
        if name in ("step", "return", "level", "attained", "length", "tau_prime"):
            tolerance = {"abs": 0, "rel": 1e-6, "nan_ok": True}
        assert actual[name] == pytest.approx(column, **tolerance), name


def slow(*options):
    return pytest.param(options, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "options",
    [
        BANDIT,
        COPY,
        slow(*BANDIT, "loss=pmd_entropy", "project_steps=4"),
        slow(*BANDIT, "loss=urex"),
        slow(*BANDIT, "loss=ment"),
        slow(*COPY, "env=reversed_addition", "env.head=joint", "loss=pmd_entropy"),
    ],
    ids=["bandit", "copy", "pmd", "urex", "ment", "reversed_addition"],
)
def test_stacked_runs_have_the_curves_of_single_ones(tmp_path, train, options):
    train(tmp_path / "stack", *options, f"seeds={[*SEEDS]}")
    for seed in SEEDS:
        single, stacked = tmp_path / str(seed), tmp_path / f"stack/seed_{seed}"
        train(single, *options, f"seed={seed}")
        assert len(read_metrics(single)["step"]) == 100
        assert_same_curves(stacked, single)
        # A directory like that of a single run, but for the checkpoints, which are the stack's.
        names = {path.name for path in single.iterdir()} - {"checkpoints"}
        assert {path.name for path in stacked.iterdir()} == names
        assert OmegaConf.load(stacked / "config.yaml") == OmegaConf.load(single / "config.yaml")
        assert json.loads((stacked / "summary.json").read_text())["finished"] is True
    if options is COPY:
        taus = [read_metrics(tmp_path / f"stack/seed_{seed}")["tau_prime"] for seed in SEEDS]
        assert taus[0][-1] != taus[1][-1], "each run begins to anneal when it has cracked the task"


@pytest.mark.parametrize("options", [BANDIT, COPY], ids=["bandit", "copy"])
def test_a_resumed_stack_goes_on_as_if_never_stopped(tmp_path, train, options):
    options = (*options, "seeds=[1,2]", "total_trajectories=240")
    train(tmp_path / "whole", *options)
    broken = tmp_path / "broken"
    with pytest.raises(SystemExit):
        train(broken, *options, stop_at=120)
    assert read_metrics(broken / "seed_1")["step"][-1] == 120
    train(broken, *options, f"resume={broken}")
    for seed in (1, 2):
        resumed, whole = (
            read_metrics(top / f"seed_{seed}") for top in (broken, tmp_path / "whole")
        )
        assert str(resumed) == str(whole)  # as text, in which NaN equals NaN


@pytest.mark.parametrize("seeds", ["3", "[]", "[0,0]", "[0.5]", "[true,2]", "two"])
def test_bad_seeds_are_refused(tmp_path, train, seeds):
    with pytest.raises(ValueError, match="seeds must be a list of different integers"):
        train(tmp_path, *BANDIT, f"seeds={seeds}")


def test_tasks_that_cannot_be_stacked_are_refused(tmp_path, train):
    with pytest.raises(ValueError, match=r"got env\.kind='gym'.*--multirun seed=0,1"):
        train(tmp_path, "env=gym", "seeds=[0,1]")
    with pytest.raises(ValueError, match=r"collector=single, got .*'process'"):
        train(tmp_path, *BANDIT, "collector=multi_sync", "seeds=[0,1]")
    with pytest.raises(TypeError, match="distinct histories"):
        train(tmp_path, *COPY, "env.distinct_histories=false", "seeds=[0,1]")
    with pytest.raises(TypeError, match="got TransformedEnv"):
        stack_envs([TransformedEnv(BanditEnv(group_size=2))])


def test_a_run_that_breaks_is_named(tmp_path, train, monkeypatch):
    def check(run, values, step):
        if run.name.endswith("seed_4"):
            raise FloatingPointError(f"loss_actor is nan, not {values['loss_actor']}")

    monkeypatch.setattr(Run, "check", check)
    with pytest.raises(FloatingPointError, match="bandit/ecpo/seed_4: loss_actor is nan"):
        train(tmp_path, *BANDIT, "seeds=[3,4]")


def test_histories_of_different_runs_are_not_shared_and_in_order():
    symbols = torch.randint(3, (6, 8))
    starts = (torch.arange(6) == 0).unsqueeze(1).expand(6, 8)
    mask = torch.rand(6, 8) < 0.8
    mask[0] = True
    mask = mask.cummin(0).values
    runs = torch.tensor([0, 0, 0, 1, 1, 1, 1, 2])
    both = distinct_histories(symbols, starts, mask, num_symbols=3, runs=runs, num_runs=3)
    for run in range(3):
        rows = runs == run
        own = distinct_histories(symbols[:, rows], starts[:, rows], mask[:, rows], num_symbols=3)
        assert own.counts == [sizes[run] for sizes in both.sizes]
        assert (both.nodes[:, rows] >= 0).equal(own.nodes >= 0)
        # The same order of nodes, so that a run's products have the same factors.
        first = torch.tensor(both.counts).cumsum(0) - torch.tensor(both.counts)
        before = torch.tensor([sum(sizes[:run]) for sizes in both.sizes])
        own_first = torch.tensor(own.counts).cumsum(0) - torch.tensor(own.counts)
        within = both.nodes[:, rows] - (first + before).unsqueeze(1)
        assert within[mask[:, rows]].equal((own.nodes - own_first.unsqueeze(1))[mask[:, rows]])


def test_a_run_samples_and_steps_as_alone():
    envs = [AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=s) for s in (0, 1)]
    alone = [AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=s) for s in (0, 1)]
    for each in (envs[1], alone[1]):
        each.curriculum.levels.fill_(7)
    env = stack_envs(envs)
    action = torch.randint(2, (4, 3, 3))
    reset = torch.tensor([True, False, False, True]).expand(3, 4).t().unsqueeze(-1)
    for _ in range(3):
        whole, parts = env.reset(), [each.reset() for each in alone]
        whole = env.step(whole.set("action", action))["next"]
        parts = [
            own.step(part.set("action", chosen))["next"]
            for own, part, chosen in zip(alone, parts, action.split(2), strict=True)
        ]
        keys = ("observation", "reward", "done", "level", "attainable")
        assert (whole.select(*keys) == torch.cat([part.select(*keys) for part in parts])).all()
        flags = ("done", "terminated", "truncated")
        whole = env.reset(whole.select(*flags).set("_reset", reset))
        parts = [
            own.reset(part.select(*flags).set("_reset", rows))
            for own, part, rows in zip(alone, parts, reset.split(2), strict=True)
        ]
        assert whole["observation"].equal(torch.cat([part["observation"] for part in parts]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16])
def test_a_run_draws_as_alone(dtype):
    logits, states = torch.zeros(5, 7, dtype=dtype), []
    alone = []
    for seed, rows in ((3, 2), (4, 3)):
        torch.manual_seed(seed)
        states.append(torch.get_rng_state())
        own = TupleCategorical(logits[:rows], (2, 2, 3))
        alone.append(own.sample())
    uniform = _RandomStreams(states).uniform([2, 3], logits)
    assert TupleCategorical(logits, (2, 2, 3)).choose(uniform).equal(torch.cat(alone))


def test_policies_see_their_part_of_the_stacked_parameters():
    actors = [make_tuple_policy(4, (2, 2, 3), hidden_size=8) for _ in range(2)]
    before = [[parameter.clone() for parameter in actor.parameters()] for actor in actors]
    stacked = stack_policies(actors, [torch.get_rng_state()] * 2)
    for whole, *parts in zip(stacked.parameters(), *before, strict=True):
        assert whole.equal(torch.stack(parts))
    with torch.no_grad():
        for whole in stacked.parameters():
            whole.mul_(2)
    for actor, old in zip(actors, before, strict=True):
        assert all(a.equal(2 * b) for a, b in zip(actor.parameters(), old, strict=True))


def _softmax_policies():
    return [make_softmax_policy(torch.eye(3)) for _ in range(2)], TensorDict(batch_size=4)


def _tuple_policies():
    policies = [make_tuple_policy(num_observations=6, nvec=(2, 2, 5)) for _ in range(2)]
    env = TransformedEnv(AlgorithmicEnv("copy", num_groups=2, group_size=2), InitTracker())
    return policies, env.reset().reshape(4)


@pytest.mark.parametrize("make", [_softmax_policies, _tuple_policies])
def test_rows_must_come_run_after_run(make):
    """Otherwise a run would get the actions of another."""
    policies, batch = make()
    stacked = stack_policies(policies, [torch.get_rng_state()] * 2)
    with pytest.raises(ValueError, match=r"run after run, got 'run' = \[0, 1, 0, 1\]"):
        stacked(batch.set("run", torch.tensor([0, 1, 0, 1])))
    assert stacked(batch.set("run", torch.tensor([0, 0, 1, 1])))["action"].shape[0] == 4
