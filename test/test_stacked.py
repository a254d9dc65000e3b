"""Stacked runs are the runs that they would be alone."""

from __future__ import annotations

import json
import os
import signal

import pytest
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError
from torchrl.envs import GymEnv, InitTracker, TransformedEnv

from torchrl_ecpo.envs import AlgorithmicEnv, BanditEnv
from torchrl_ecpo.experiment import Checkpoints, Run, read_metrics
from torchrl_ecpo.experiment._files import seal
from torchrl_ecpo.modules import TupleCategorical, make_softmax_policy, make_tuple_policy
from torchrl_ecpo.modules.histories import distinct_histories, hash_histories

BANDIT = ("env=bandit", "env.num_actions=50", "group_size=10", "total_trajectories=600")
COPY = (
    *("env=copy", "policy.hidden_size=16", "num_groups=4", "group_size=5", "project_steps=2"),
    *("total_trajectories=320", "evaluation.interval=13", "optim.max_grad_norm=0.5"),
    "anneal_from={metric:return,at_least:-0.12}",
)
PAPER = (*COPY, "form=paper")
ANNEALED = (
    *COPY,
    "epochs=3",
    "loss.tau_prime={schedule:linear,start:0.3,end:0,duration:4000}",
)
SEEDS = (3, 11)


@pytest.fixture
def train(run_here, monkeypatch):
    """Runs the script in this process, in a directory; until SIGTERM if `stop_at` says when."""
    boundary = Checkpoints.boundary

    def train(directory, *options, stop_at=None):
        def stop(checkpoints):
            if checkpoints.step == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            boundary(checkpoints)

        monkeypatch.setattr(Checkpoints, "boundary", stop)
        run_here(directory, "ecpo", *options, bare=True)

    return train


def assert_same_curves(actual, expected):
    """Equal to float tolerance; what was sampled is equal altogether."""
    actual, expected = read_metrics(actual), read_metrics(expected)
    assert actual.keys() == expected.keys()
    for name, column in expected.items():
        tolerance = {"abs": 1e-5, "rel": 1e-4, "nan_ok": True}
        if name in ("step", "return", "level", "attained", "length", "tau_prime"):
            tolerance = {"abs": 0, "rel": 1e-6, "nan_ok": True}
        assert actual[name] == pytest.approx(column, **tolerance), name


@pytest.mark.parametrize(
    "options",
    [
        ANNEALED,
        (*COPY, "policy=window", "epochs=2"),
        (*PAPER, "policy=lstm"),
        pytest.param(
            (*PAPER, "policy=lstm", "env=reversed_addition", "loss=pmd_entropy"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["memoryless", "window", "lstm", "reversed_addition"],
)
def test_stacked_runs_have_the_curves_of_single_ones(tmp_path, train, options):
    train(tmp_path / "stack", *options, f"seeds={[*SEEDS]}")
    for seed in SEEDS:
        single, stacked = tmp_path / str(seed), tmp_path / f"stack/seed_{seed}"
        train(single, *options, f"seed={seed}")
        metrics = read_metrics(single)
        assert len(metrics["step"]) == 16
        assert sum(x == x for x in metrics["pass_at_10"]) == 1
        assert_same_curves(stacked, single)
        # A directory like that of a single run, but for the checkpoints, which are the stack's.
        names = {path.name for path in single.iterdir()} - {"checkpoints"}
        assert {path.name for path in stacked.iterdir()} == names
        assert OmegaConf.load(stacked / "config.yaml") == OmegaConf.load(single / "config.yaml")
        assert json.loads((stacked / "summary.json").read_text())["finished"] is True
    if options is ANNEALED:
        taus = [read_metrics(tmp_path / f"stack/seed_{seed}")["tau_prime"] for seed in SEEDS]
        assert taus[0][-1] != taus[1][-1], "each run begins to anneal when it has cracked the task"


SETTINGS = {
    "bandit": (BANDIT, ("loss=ecpo seed=3", "loss=urex loss.tau=0.2,0.5 seed=4")),
    "copy": (
        PAPER,
        (
            "loss=ecpo loss.tau=0.25,1.0 seed=3",
            "loss=urex seed=4 env.curriculum=group optim.lr=0.003 optim.amsgrad=false",
            "loss=ment seed=3 project_steps=1 anneal_from=null evaluation.interval=15",
            "loss=pmd seed=4",
        ),
    ),
    "epochs": (
        (*COPY, "total_trajectories=200"),
        ("seed=3 epochs=5 max_kl=0.02", "seed=4 epochs=2", "loss=reps seed=3 epochs=3"),
    ),
}
RUNS = {
    "bandit": (
        "loss=ecpo seed=3",
        "loss=urex loss.tau=0.2 seed=4",
        "loss=urex loss.tau=0.5 seed=4",
    ),
    "copy": (
        "loss=ecpo loss.tau=0.25 seed=3",
        "loss=ecpo loss.tau=1.0 seed=3",
        *SETTINGS["copy"][1][1:],
    ),
    "epochs": SETTINGS["epochs"][1],
}


@pytest.mark.parametrize("task", SETTINGS)
def test_methods_and_settings_are_stacked(tmp_path, train, task):
    options, entries = SETTINGS[task]
    train(tmp_path / "stack", *options, f"stack={[*entries]}")
    for index, own in enumerate(RUNS[task]):
        single, stacked = tmp_path / str(index), tmp_path / f"stack/run_{index}"
        train(single, *options, *own.split())
        assert_same_curves(stacked, single)
        assert OmegaConf.load(stacked / "config.yaml") == OmegaConf.load(single / "config.yaml")
    assert len(list((tmp_path / "stack").glob("run_*"))) == len(RUNS[task])
    if task == "epochs":
        steps = [read_metrics(tmp_path / f"stack/run_{i}")["gradient_steps"] for i in range(3)]
        assert len({*steps[0]}) > 1, "some batches are left early"
        assert [{*each} for each in steps[1:]] == [{2}, {3}]


def ends(directory):
    """The last step of each run, by its directory, and whether it says that it is finished."""
    runs = sorted(path.parent for path in directory.glob("**/summary.json"))
    assert all(json.loads((run / "summary.json").read_text())["finished"] for run in runs)
    return {run.name: read_metrics(run)["step"][-1] for run in runs}


GOAL = "stop_when={metric:expected_reward,at_least:0.6,batches:3}"


def test_a_stack_stops_when_all_its_runs_hold_their_goals(tmp_path, train):
    """Those that hold theirs go on until the last one does; for good, also when resumed."""
    for seed in SEEDS:
        train(tmp_path / f"seed_{seed}", *BANDIT, GOAL, f"seed={seed}")
    alone = {f"seed_{seed}": ends(tmp_path / f"seed_{seed}")[f"seed_{seed}"] for seed in SEEDS}
    first, last = sorted(alone.values())
    assert first < last < 600
    stack = tmp_path / "stack"
    train(stack, *BANDIT, GOAL, f"seeds={[*SEEDS]}")
    assert ends(stack) == dict.fromkeys(alone, last)
    train(stack, *BANDIT, GOAL, f"seeds={[*SEEDS]}", f"resume={stack}")
    assert ends(stack) == dict.fromkeys(alone, last)
    train(tmp_path / "some", *BANDIT, GOAL, f"stack=['seed={SEEDS[0]}','seed=1 stop_when=null']")
    assert {*ends(tmp_path / "some").values()} == {600}, "a run without a goal needs all"


STACK = "stack=['loss=ecpo seed=1','loss=reps seed=2 project_steps=1']"


@pytest.mark.parametrize("options", [(*BANDIT, "seeds=[1,2]"), (*COPY, STACK)])
def test_a_resumed_stack_goes_on_as_if_never_stopped(tmp_path, train, options):
    options = (*options, "total_trajectories=240")
    train(tmp_path / "whole", *options)
    broken = tmp_path / "broken"
    with pytest.raises(SystemExit):
        train(broken, *options, stop_at=100)  # in the middle of a projection of ECPO on Copy
    runs = sorted(path.parent.name for path in (tmp_path / "whole").glob("*/metrics.csv"))
    assert len(runs) == 2
    assert read_metrics(broken / runs[0])["step"][-1] == 100
    (checkpoint,) = (broken / "checkpoints").iterdir()
    before = (checkpoint / "manifest.json").read_text()
    with (checkpoint / "manifest.json").open("w") as file:
        file.write(before.replace('"epochs": 1', '"epochs": 2'))
    seal(checkpoint)
    with pytest.raises(CheckpointError, match=rf"runs\.{runs[0]}\.epochs was 20?, is 10?"):
        train(broken, *options, f"resume={broken}")
    (checkpoint / "manifest.json").write_text(before)
    train(broken, *options, f"resume={broken}")
    for run in runs:
        resumed, whole = read_metrics(broken / run), read_metrics(tmp_path / "whole" / run)
        assert str(resumed) == str(whole)  # as text, in which NaN equals NaN


@pytest.mark.parametrize(
    ("runs", "directory"),
    [((f"seeds={[*SEEDS]}",), "seed_11"), (("stack=['seed=3 epochs=2','seed=11']",), "run_1")],
)
def test_play_shows_a_run_as_it_was_trained(tmp_path, train, script, capsys, runs, directory):
    options = (*COPY, "total_trajectories=200")
    train(tmp_path / "alone", *options, f"seed={SEEDS[1]}")
    train(tmp_path / "stack", *options, *runs)
    shown = []
    for run in (tmp_path / "alone", tmp_path / "stack" / directory):
        capsys.readouterr()
        script("play").main([str(run), "--level", "5", "--episodes", "3"])
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]
    episodes = shown[0].strip().split("\n\n")
    assert len(episodes) == 3
    for episode in episodes:
        head, *tracks = episode.splitlines()
        reads, moves, writes = (track[8:] for track in tracks)
        assert len(reads) == len(moves) >= len(writes)
        # Copy's head moves along one row; what it read it can go back to.
        place, tape = 0, {}
        for character, move in zip(reads, moves, strict=True):
            assert tape.setdefault(place, character) == character
            place += {"<": -1, ">": 1}[move]
        assert head.startswith("return ")
        assert head.removesuffix(", solved").endswith((" of 5", " of 6", " of 7"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "No such file"),
        (("--level", "0"), "--level must be"),
        (("--episodes", "0"), "--episodes must be"),
    ],
)
def test_play_refuses_what_it_cannot_show(tmp_path, script, capsys, options, message):
    with pytest.raises(SystemExit):
        script("play").main([str(tmp_path), *options])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", ["seeds", "stack"])
@pytest.mark.parametrize("given", [3, [], [0.5], [True, 2], "two", {}])
def test_what_is_no_list_of_runs_is_refused(script, name, given):
    config = OmegaConf.create({"seeds": None, "stack": None, name: given})
    with pytest.raises(ValueError, match=f"{name} must be a list of"):
        script("stacked.options").runs_of(config, [])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["seeds=[0,0]"], "seeds must be a list of different integers"),
        (["stack=['seed=0,1','seed=1']"], "'seed=1' is there twice"),
        (["seeds=[0,1]", "stack=['seed=2']"], "seeds or stack, not both"),
        (["stack=['seeds=[0,1]']"], r"stack: seeds=\[0,1\] is for all runs together, got it in"),
        (["stack=['compile=true seed=1']"], "compile=true is for all runs together"),
        (["stack=['loss.tua=1']"], "no option loss.tua; the nearest one is loss.tau"),
        (["stack=['project_steps=0']"], "project_steps must be an integer >= 1, got 0"),
        (["stack=['env=copy','env=reverse']"], "must agree in env.name, got copy and reverse"),
        (["stack=['seed=0','group_size=5']"], "must agree in group_size, got 100 and 5. They may"),
        (["loss=trust_pcl", "seeds=[0,1]"], r"a value network, such as loss=trust_pcl"),
        (["env=gym", "seeds=[0,1]"], r"got env\.kind='gym'.*--multirun"),
        (["collector=multi_sync", "seeds=[0,1]"], r"collector=single, got .*'process'"),
        (["env=copy", "stack=['policy=lstm','seed=1']"], "must agree in policy.name, got lstm and"),
    ],
)
def test_what_cannot_be_stacked_is_refused_before_a_directory_is_made(
    tmp_path, train, options, message
):
    with pytest.raises((ValueError, HydraException), match=message):
        train(tmp_path, *options)
    assert not list(tmp_path.iterdir())


def test_stacked_runs_go_on_to_whole_projections_of_each(tmp_path, train):
    """Of 20 and 30 trajectories a lift: 40 become 60, of which a run alone has the first 40."""
    tiny = ("env.num_actions=30", "group_size=10", "total_trajectories=40")
    train(tmp_path / "stack", *tiny, "stack=['project_steps=2','project_steps=3']")
    train(tmp_path / "single", *tiny, "project_steps=2")
    for name in ("run_0", "run_1"):
        assert read_metrics(tmp_path / "stack" / name)["step"] == [10, 20, 30, 40, 50, 60]
    alone, stacked = read_metrics(tmp_path / "single"), read_metrics(tmp_path / "stack/run_0")
    assert alone["step"] == [10, 20, 30, 40]
    assert stacked["return"][:4] == pytest.approx(alone["return"], rel=1e-5)


def test_a_goal_is_held_in_so_many_batches_in_a_row_and_then_for_good(script):
    goal = OmegaConf.create({"metric": "return", "at_least": 1.0, "batches": 2})
    so_far, found = 0, []
    for value in (1.0, 0.9, 1.0, 1.1, 0.0, 1.0):
        so_far = script("utils").held(goal, so_far, {"return": value})
        found.append(so_far)
    assert found == [1, 0, 1, 2, 2, 2]


def test_a_run_that_breaks_is_named(tmp_path, train, monkeypatch):
    def check(run, values, step):
        if run.name.endswith("seed_4"):
            raise FloatingPointError(f"loss_actor is nan, not {values['loss_actor']}")

    monkeypatch.setattr(Run, "check", check)
    with pytest.raises(FloatingPointError, match="bandit/ecpo/seed_4: loss_actor is nan"):
        train(tmp_path, *BANDIT, "seeds=[3,4]")


def test_histories_of_different_runs_are_not_shared_and_in_order(script):
    """The same order of nodes as alone, so that a run's products have the same factors."""
    policies = [make_tuple_policy(2, (1, 2, 1), hidden_size=4) for _ in range(3)]
    core = script("stacked.policies").stack_policies(policies, [torch.get_rng_state()] * 3).core
    symbols = torch.randint(3, (6, 8))
    starts = (torch.arange(6) == 0).unsqueeze(1).expand(6, 8)
    mask = torch.rand(6, 8) < 0.8
    mask[0] = True
    mask = mask.cummin(0).values
    runs = torch.tensor([0, 0, 0, 1, 1, 1, 1, 2])
    both = core.find_histories(symbols + core.num_symbols * runs, starts, mask, None)
    first = torch.tensor(both.counts).cumsum(0) - torch.tensor(both.counts)
    for run in range(3):
        rows = runs == run
        hashes = hash_histories(symbols[:, rows], starts[:, rows], num_symbols=core.num_symbols)
        own = distinct_histories(hashes, starts[:, rows], mask[:, rows])
        assert own.counts == [sizes[run] for sizes in both.sizes]
        assert (both.nodes[:, rows] >= 0).equal(own.nodes >= 0)
        before = torch.tensor([sum(sizes[:run]) for sizes in both.sizes])
        own_first = torch.tensor(own.counts).cumsum(0) - torch.tensor(own.counts)
        within = both.nodes[:, rows] - (first + before).unsqueeze(1)
        assert within[mask[:, rows]].equal((own.nodes - own_first.unsqueeze(1))[mask[:, rows]])


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: AlgorithmicEnv("reverse"), r"copy in a batch \(1, 1\) and reverse in a batch"),
        (lambda: AlgorithmicEnv("copy", group_size=2), r"copy in a batch \(1, 1\) and copy in a"),
        (lambda: BanditEnv(num_actions=3), "and a bandit of 3 actions"),
        (lambda: GymEnv("CartPole-v1"), "AlgorithmicEnv and BanditEnv can be stacked, got"),
    ],
)
def test_environments_of_different_tasks_are_not_stacked(script, other, message):
    with pytest.raises((TypeError, ValueError), match=message):
        script("stacked.envs").stack_envs([AlgorithmicEnv("copy"), other()])


def test_a_run_samples_and_steps_as_alone(script):
    envs = [AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=s) for s in (0, 1)]
    alone = [AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=s) for s in (0, 1)]
    for each in (envs[1], alone[1]):
        each.curriculum.levels.fill_(7)
    env = script("stacked.envs").stack_envs(envs)
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
def test_a_run_draws_as_alone(script, dtype):
    logits, states = torch.zeros(5, 7, dtype=dtype), []
    alone = []
    for seed, rows in ((3, 2), (4, 3)):
        torch.manual_seed(seed)
        states.append(torch.get_rng_state())
        own = TupleCategorical(logits[:rows], (2, 2, 3))
        alone.append(own.sample())
    uniform = script("stacked.policies").RandomStreams(states).uniform([2, 3], logits)
    assert TupleCategorical(logits, (2, 2, 3)).choose(uniform).equal(torch.cat(alone))


def _softmax_policies():
    observation = torch.ones(4, 1)
    return [make_softmax_policy(torch.eye(3)) for _ in range(2)], TensorDict(
        observation=observation, batch_size=4
    )


def _tuple_policies():
    policies = [make_tuple_policy(num_observations=6, nvec=(2, 2, 5)) for _ in range(2)]
    env = TransformedEnv(AlgorithmicEnv("copy", num_groups=2, group_size=2), InitTracker())
    return policies, env.reset().reshape(4)


@pytest.mark.parametrize("make", [_softmax_policies, _tuple_policies])
def test_rows_must_come_run_after_run(script, make):
    """Otherwise a run would get the actions of another."""
    policies, batch = make()
    stacked = script("stacked.policies").stack_policies(policies, [torch.get_rng_state()] * 2)
    with pytest.raises(ValueError, match=r"run after run, got 'run' = \[0, 1, 0, 1\]"):
        stacked(batch.set("run", torch.tensor([0, 1, 0, 1])))
    assert stacked(batch.set("run", torch.tensor([0, 0, 1, 1])))["action"].shape[0] == 4
