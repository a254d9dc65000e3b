"""The script, started as a user would start it, and what it is built from.

What does not depend on the command line is run in the process of the tests.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import sys
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from processes import run_script
from tensordict import TensorDict
from torchrl.envs import GymWrapper
from torchrl.modules import set_recurrent_mode

from torchrl_ecpo.experiment import _tasks, compare, compose_options, read_metrics
from torchrl_ecpo.experiment._tasks import is_plain, open_task

ROOT = Path(__file__).parents[1]
ECPO = ROOT / "sota-implementations/ecpo/ecpo.py"
TINY = ("env.num_actions=30", "total_trajectories=60", "group_size=10")


def sized(options):
    """With the size of a short run, if the options are for the bandit."""
    return options if any(option.startswith("env=") for option in options) else (*TINY, *options)


def start(directory, *overrides):
    flags = [override for override in overrides if override.startswith("--")]
    options = [override for override in overrides if override not in flags]
    afresh = "collector=ray" in options or "hydra/launcher" in " ".join(options)
    return run_script(directory, ECPO, *flags, *sized(options), afresh=afresh)


def run_ecpo(directory, *options):
    process = start(directory, *options)
    assert process.returncode == 0, process.stderr


@pytest.fixture
def train(run_here):
    """Runs the script in this process, in a directory."""

    def train(directory, *options):
        run_here(directory, "ecpo", *sized(options))
        return read_metrics(directory)

    return train


LOSSES = sorted(path.stem for path in (ECPO.parent / "config/loss").glob("*.yaml"))
SWEPT = ("ecpo", "ment", "urex")
LIFTS = ("form=paper", "seed=5", "project_steps=3")  # the form gives UREX, MENT, PMD temperatures


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Some losses, by one start of the script."""
    directory = tmp_path_factory.mktemp("sweep")
    (directory / "mine").mkdir()
    where = (f"hydra.sweep.dir={directory}", "hydra.sweep.subdir=${loss.name}", "--config-dir=mine")
    run_ecpo(directory, "--multirun", f"loss={','.join(SWEPT)}", *LIFTS, *where)
    return directory


@pytest.mark.parametrize("loss", SWEPT)
def test_a_sweep_leaves_a_directory_for_each_run(sweep, loss):
    run = sweep / loss
    check_lifts(read_metrics(run))
    assert json.loads((run / "summary.json").read_text())["finished"] is True
    assert OmegaConf.load(run / "config.yaml").loss.name == loss
    assert (run / "curve.png").exists()
    command = (run / "command.txt").read_text()
    options = [f"--config-dir={sweep / 'mine'}", *TINY, f"loss={loss}", *LIFTS]
    assert command == f"python {ECPO} {' '.join(options)}\n"
    commit = json.loads((run / "versions.json").read_text())["commit"]
    assert re.fullmatch(r"[0-9a-f]{40}(-dirty)?|unknown", commit)
    assert not list(run.glob("*.log"))


@pytest.mark.parametrize("loss", [loss for loss in LOSSES if loss not in SWEPT])
def test_every_other_loss_trains_on_the_bandit(tmp_path, train, loss):
    check_lifts(train(tmp_path, f"loss={loss}", *LIFTS))


def test_a_loss_of_ones_own(tmp_path, script, monkeypatch):
    """By its import path, from a configuration beside it."""
    (tmp_path / "mine.py").write_text(
        "from torchrl_ecpo import ECPOLoss\n\n\nclass MyLoss(ECPOLoss):\n    pass\n"
    )
    (tmp_path / "loss").mkdir()
    (tmp_path / "loss/mine.yaml").write_text("name: mine\nclass: mine.MyLoss\ntau: 0.5\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    options = ("--config-dir", str(tmp_path), "loss=mine", *TINY)
    process = run_script(tmp_path, ECPO, *options, afresh=True)
    assert process.returncode == 0, process.stderr
    (run,) = tmp_path.glob("runs/*/mine/seed_0/*")
    assert json.loads((run / "summary.json").read_text())["finished"] is True
    loss_class = script("utils").loss_class
    monkeypatch.syspath_prepend(tmp_path)
    for name, reason in (("mine.Nothing", ": .*'mine'"), ("json.JSONDecoder", r"\.$")):
        message = rf"(?s)loss.class must be a loss over groups.* got '{name}'{reason}"
        with pytest.raises(ValueError, match=message):
            loss_class(OmegaConf.create({"name": "mine", "class": name}))


def check_lifts(metrics):
    """Of which one is at trajectories 1 to 30, the other at 31 to 60.

    Right after a lift the policy is the reference, then it moves away.
    """
    assert metrics["step"] == [10, 20, 30, 40, 50, 60]
    kl = metrics["kl_reference_policy"]
    assert kl[0] == kl[3] == 0
    assert all(kl[i] != 0 for i in (1, 2, 4, 5))


def test_the_same_seed_gives_the_same_run_in_another_process(sweep, tmp_path):
    run_ecpo(tmp_path, *LIFTS, f"hydra.run.dir={tmp_path}")
    assert read_metrics(tmp_path) == read_metrics(sweep / "ecpo")


def test_seeds_are_other_problems_and_schedules_and_ablations_are_options(sweep, tmp_path):
    run_ecpo(
        tmp_path,
        "--multirun",
        "form=paper",
        "seed=6",
        "project_steps=1",
        "loss.tau_prime={schedule:linear,start:0.5,end:0.0,duration:40},0",
        f"hydra.sweep.dir={tmp_path}",
        "hydra.sweep.subdir=${hydra:job.num}",
    )
    scheduled, without_entropy = read_metrics(tmp_path / "0"), read_metrics(tmp_path / "1")
    assert scheduled["expected_reward"][0] != read_metrics(sweep / "ecpo")["expected_reward"][0]
    assert scheduled["tau_prime"] == pytest.approx([0.5, 0.375, 0.25, 0.125, 0, 0])
    assert set(without_entropy["tau_prime"]) == {0}
    assert set(without_entropy["kl_reference_policy"]) == {0}, "one step a lift: no projection"


def test_several_gradient_steps_on_a_batch(tmp_path, train):
    one, three = (train(tmp_path / str(n), "seed=5", f"epochs={n}") for n in (1, 3))
    assert {*one["gradient_steps"]} == {1}
    assert {*three["gradient_steps"]} == {3}
    assert {*one["kl_reference_policy"]} == {0}, "of the policy before the only step"
    assert 0 not in three["kl_reference_policy"]
    # What a batch says of the policy that drew it, which is the same in the first one.
    changed = {name for name in one if one[name][0] != three[name][0]}
    assert changed == {"kl_reference_policy", "gradient_steps", "expected_reward"}


TWO_BATCHES = ("total_trajectories=20", "num_groups=5", "group_size=2")


@pytest.mark.parametrize("name", ["deep_sea", "frozenlake", "mountaincar"])
def test_tasks_of_exploration_say_how_many_episodes_are_solved(tmp_path, train, name):
    metrics = train(tmp_path, f"env={name}", *TWO_BATCHES)
    assert len(metrics["pass_at_1"]) == 2
    assert all(0 <= share <= 1 for share in metrics["pass_at_1"] + metrics["pass_at_k"])
    assert metrics["pass_at_1"][0] <= metrics["pass_at_k"][0]


@pytest.mark.parametrize("policy", ["lstm", "window", "memoryless"])
def test_a_task_of_popgym_is_played_with_and_without_memory(tmp_path, train, script, policy):
    options = ("env=popgym", f"policy={policy}", "env.max_steps=6", "evaluation.interval=1")
    metrics = train(tmp_path, *options, *TWO_BATCHES)
    script("play").main([str(tmp_path), "--episodes", "1"])
    assert len(metrics["greedy_return"]) == 2
    assert all(-1 <= value <= 1 for value in metrics["return"] + metrics["greedy_return"])


def test_a_window_shows_the_last_observations(script):
    env, one = (script("tasks").open_task("CartPole-v1", n) for n in (3, 1))
    seen = [one.reset(seed=1)[0], *(one.step(0)[0] for _ in range(2))]
    assert env.reset(seed=1)[0].tolist() == [0.0] * 8 + seen[0].tolist()
    env.step(0)
    assert env.step(0)[0].reshape(3, 4).tolist() == [row.tolist() for row in seen]


def test_an_lstm_tells_an_observation_by_what_came_before(script):
    tasks = script("tasks")
    env = GymWrapper(tasks.open_task("CartPole-v1"), categorical_action_encoding=True)
    actor = tasks.make_gym_policy(env, [8], units=4)
    steps = TensorDict(observation=torch.zeros(2, 3, 4), batch_size=[2, 3])
    steps["observation"][1, 0] = 1.0
    steps["is_init"] = (torch.arange(3) == 0).expand(2, 3).unsqueeze(-1)
    with set_recurrent_mode(True):
        logits = actor.get_dist(steps).logits
    assert (logits[0] != logits[1]).all()


def test_episodes_and_groups_that_earn_as_much_are_counted(script):
    reward = torch.tensor([[[0.0, 1.0], [0.0, 0.0]], [[0.5, 0.5], [0.5, 1.0]], [[0, 0], [0, 0.5]]])
    done = torch.tensor([False, True]).expand(3, 2, 2).clone()
    done[1, 1, 0] = True  # what is after the end earns nothing
    step = {"reward": reward.unsqueeze(-1), "done": done.unsqueeze(-1)}
    action = torch.tensor([[[1, 1], [1, 1]], [[0, 1], [0, 0]], [[1, 1], [1, 1]]])
    mask = ~done.roll(1, 2) | torch.tensor([True, False])
    groups = TensorDict(
        {"next": step, "action": action, "collector": {"mask": mask}, "other": {"action": action}},
        [3, 2, 2],
    )
    passes = script("tasks").passes
    expected = {"pass_at_1": pytest.approx(2 / 6), "pass_at_k": pytest.approx(2 / 3)}
    assert passes(groups, solved=1) == {**expected, "distinct_solutions": pytest.approx(2 / 3)}
    reward[1, 1, 0] = 1.0  # a second way in the group, and in the first one the same again
    groups["next", "reward"][0] = 1.0
    assert passes(groups, solved=1)["distinct_solutions"] == 1
    reward[2, 1] = torch.tensor([1 - 1e-7, 0.0])  # as of parts that add up to 1
    assert passes(groups, solved=1)["pass_at_1"] == pytest.approx(5 / 6)
    reward[2, 1] = 0.0
    groups["other", "action"] = torch.randn(3, 2, 2, 5)  # the same by one part of the action
    keys = ["action", ("other", "action")]
    assert passes(groups, solved=1, action_keys=keys)["distinct_solutions"] == pytest.approx(4 / 3)


def test_metrics_of_a_batch_are_those_of_its_first_step_but_for_the_divergence(script):
    is_far, of_batch = script("utils").is_far, script("utils").of_batch
    of_steps = [
        {"loss_actor": float(i), "kl_reference_policy": kl, "grad_norm": 7.0 + i}
        for i, kl in enumerate((0.0, 0.1, 0.3))
    ]
    first = {"loss_actor": 0.0, "grad_norm": 7.0}
    expected = {**first, "kl_reference_policy": 0.3, "gradient_steps": 3}
    assert of_batch(of_steps) == expected
    assert [is_far(of_steps, bound) for bound in (None, 0.3, 0.29)] == [False, False, True]
    assert not is_far([{"kl_reference_policy": 9.0}], 0.0), "the first step is always made"
    del of_steps[-1]["grad_norm"]  # it was too far
    assert of_batch(of_steps) == {**expected, "gradient_steps": 2}


def test_a_run_stops_once_it_holds_its_goal_and_is_finished(tmp_path, train):
    options, stopped = ("seed=1", "total_trajectories=200"), tmp_path / "stopped"
    metrics = train(tmp_path / "free", *options)

    def batches_until(goal):
        """Until it was held twice in a row, and how often it was held."""
        is_held = [value >= goal for value in metrics["return"]]
        pairs = [a and b for a, b in pairwise(is_held)]
        last = pairs.index(True) + 2 if True in pairs else len(is_held)
        return last, sum(is_held[:last])

    # One that is held once before it is held twice.
    goal = next(g for g in metrics["return"] if batches_until(g)[1] == 3)
    last, _ = batches_until(goal)
    assert last < len(metrics["step"])
    goal = f"stop_when={{metric:return,at_least:{goal},batches:2}}"
    before = train(stopped, *options, goal)
    assert before == {name: column[:last] for name, column in metrics.items()}
    assert train(stopped, *options, goal, f"resume={stopped}") == before
    summary = json.loads((stopped / "summary.json").read_text())
    assert (summary["finished"], summary["trajectories"]) == (True, 10 * last)


@pytest.mark.slow  # each of the two processes imports torch
@pytest.mark.parametrize(
    "launcher", [("joblib", "hydra.launcher.n_jobs=2"), ("submitit_local",)], ids=lambda own: own[0]
)
def test_a_sweep_over_two_processes_gives_the_metrics_of_single_runs(
    sweep, tmp_path, monkeypatch, launcher
):
    monkeypatch.setenv("PYTHONPATH", str(ECPO.parent), prepend=os.pathsep)  # for submitit
    run_ecpo(
        tmp_path,
        "--multirun",
        f"hydra/launcher={launcher[0]}",
        *launcher[1:],
        "loss=ecpo,ment",
        *LIFTS,
        f"hydra.sweep.dir={tmp_path}",
        "hydra.sweep.subdir=${loss.name}",
    )
    for loss in ("ecpo", "ment"):
        assert read_metrics(tmp_path / loss) == read_metrics(sweep / loss)


SHORT = ("total_trajectories=64", "env.max_steps=5")


@pytest.mark.parametrize(
    "options",
    [
        ("env=copy", "total_trajectories=40", "num_groups=2", "evaluation.interval=1"),
        (
            *("env=reversed_addition", "loss=urex", "form=paper", "policy=lstm"),
            *("total_trajectories=40", "logger.backend=tensorboard"),
        ),
        ("env=gym", *SHORT, "evaluation.interval=1"),
        ("env=deep_sea", "total_trajectories=64", "loss=trust_pcl"),  # with a value network
        ("env=gym", *SHORT, "env.name=Pendulum-v1", "loss=ment", "form=paper"),
    ],
)
def test_every_kind_of_task_runs(tmp_path, train, options):
    check_run(train(tmp_path, "seed=1", *options))


@pytest.mark.usefixtures("forked_workers")
def test_workers_play(tmp_path, train):
    options = ("env=copy", "total_trajectories=80", "num_groups=2", "collector=multi_sync")
    check_run(train(tmp_path, "seed=1", *options))


@pytest.mark.slow  # each of the processes imports torch
@pytest.mark.parametrize("collector", ["multi_async", "ray"])
def test_workers_of_their_own_play(tmp_path, collector):
    options = ("env=gym", *SHORT, f"collector={collector}")
    run_ecpo(tmp_path, "seed=1", f"hydra.run.dir={tmp_path}", *options)
    check_run(read_metrics(tmp_path))


def check_run(metrics):
    assert metrics["step"][-1] >= 40
    assert all(math.isfinite(loss) for loss in metrics["loss_actor"])


def test_play_shows_runs_that_are_not_algorithmic(sweep, script, train, tmp_path, capsys):
    play = script("play").main
    play([str(sweep / "ecpo")])  # the bandit: what its most probable action earns
    assert re.fullmatch(r"return 0\.\d+\n", capsys.readouterr().out)
    options = ("env=gym", "env.max_steps=20", "num_groups=1", "group_size=4")
    train(tmp_path, *options, "total_trajectories=8")
    capsys.readouterr()
    play([str(tmp_path), "--episodes", "1"])
    first, mean, drawn = capsys.readouterr().out.splitlines()
    steps = int(first.split()[2])  # a reward of 1 for each
    assert first == f"return {steps}, {steps} steps"
    assert mean == f"mean return {steps}"
    assert drawn == f"the first one is drawn in {tmp_path / 'episode.gif'}"
    with Image.open(tmp_path / "episode.gif") as video:
        assert 1 < video.n_frames <= steps


@pytest.mark.parametrize(
    "name",
    [
        "Blackjack-v1",
        # Whose spaces are those of FrozenLake and MountainCar, in the test of exploration.
        *(
            pytest.param(f"{name}-v1", marks=pytest.mark.slow)
            for name in ("CliffWalking", "Acrobot")
        ),
        pytest.param("Taxi-v4", marks=pytest.mark.slow),
    ],
)
def test_the_toy_tasks_of_gymnasium_train(tmp_path, train, name):
    """Their observations are numbers, and tuples of these, and vectors."""
    check_training(tmp_path, train, name)


OWN_TASKS = """
import gymnasium as gym
import numpy as np
from gymnasium import spaces

class Own(gym.Env):
    observation_space = spaces.Dict(at=spaces.Box(-1, 1, (2,)), kind=spaces.Discrete(3))

    def __init__(self, actions, observations=observation_space, is_noisy=False):
        self.action_space, self.observation_space = actions, observations
        self.is_noisy = is_noisy

    def _observe(self):
        if not self.is_noisy:
            self.observation_space.seed(int(self.np_random.integers(1000)))
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        reward = float(spaces.flatten(self.action_space, action)[0])
        return self._observe(), reward, False, False, {}

number, choice = spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(2)
pixels = spaces.Box(0, 255, (20, 24, 3), np.uint8)
for name, options in {
    "Mixed": {"actions": spaces.Dict(a=choice, b=number)},
    "Several": {"actions": spaces.Tuple([choice, spaces.MultiDiscrete([3, 2])])},
    "Numbers": {"actions": spaces.Tuple([number, number])},
    "Pixels": {"actions": choice, "observations": pixels},
    "Graph": {"actions": choice, "observations": spaces.Graph(number, None)},
    "Noisy": {"actions": choice, "is_noisy": True},
}.items():
    gym.register(f"{name}-v0", entry_point=Own, kwargs=options)
"""


@pytest.fixture
def own_tasks(tmp_path, monkeypatch):
    """A module of one's own, and its path."""
    (tmp_path / "own_tasks.py").write_text(OWN_TASKS)
    monkeypatch.syspath_prepend(tmp_path)
    known = dict(gym.registry)
    yield "own_tasks"
    sys.modules.pop("own_tasks", None)
    gym.registry.clear()
    gym.registry.update(known)


@pytest.mark.parametrize("name", ["Mixed", "Several", "Numbers", "Pixels"])
def test_tasks_of_ones_own_train(tmp_path, train, own_tasks, name):
    check_training(tmp_path, train, f"{own_tasks}:{name}-v0")


@pytest.mark.parametrize(
    "name", ["CarRacing-v3", pytest.param("minigrid:MiniGrid-DoorKey-5x5-v0", id="DoorKey")]
)
@pytest.mark.slow
def test_tasks_of_extras_train(tmp_path, train, name):
    pytest.importorskip("Box2D" if name == "CarRacing-v3" else "minigrid")
    check_training(tmp_path, train, name)


def check_training(directory, train, name):
    """One batch of one group of three, and then one of the policy that came of it."""
    size = ("env.max_steps=4", "num_groups=1", "group_size=3", "total_trajectories=6")
    metrics = train(directory, "env=gym", f"env.name={name}", *size, "evaluation.interval=1")
    assert metrics["step"] == [3, 6]
    for column in ("loss_actor", "greedy_return", "entropy"):
        assert all(map(math.isfinite, metrics[column])), column
    assert metrics["kl_reference_policy"] == pytest.approx([0, 0], abs=1e-5)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Graph", "env.name: Graph-v0 observes Graph.*TransformObservation"),
        ("Noisy", "two copies of a problem instance differ at their start"),
        ("Missing", "env.name=own_tasks:Missing-v0 is no task of gymnasium"),
    ],
)
def test_a_task_that_cannot_be_played_is_refused_at_the_door(own_tasks, name, message):
    with pytest.raises(ValueError, match=message):
        is_plain(f"{own_tasks}:{name}-v0")


def test_a_task_whose_package_is_not_there_says_so():
    message = r"env\.name=nowhere:Task-v0 needs what is not installed"
    with pytest.raises(ModuleNotFoundError, match=message):
        open_task("nowhere:Task-v0")


def test_episodes_may_be_longer_than_what_is_taken_for_endless(script):
    options = ["env=gym", "env.max_steps=20000", "num_groups=1", "group_size=2"]
    config = compose_options(ECPO.parent, options)
    collector = script("utils").make_collector(config, script("tasks").make_task(config))
    assert collector._workers.player.max_steps == 20_000


def test_a_task_is_opened_no_more_often_than_it_is_played(script, monkeypatch):
    """Twice at the door, and for the ten copies of the evaluation and their specs."""
    is_plain.cache_clear()
    opened, open_raw_task = [], _tasks.open_raw_task
    monkeypatch.setattr(
        _tasks, "open_raw_task", lambda name: opened.append(name) or open_raw_task(name)
    )
    config = compose_options(ECPO.parent, ["env=gym", "env.name=MountainCar-v0"])
    script("utils").check_config(config)
    assert len(opened) == 2
    script("tasks").make_task(config)
    assert len(opened) == 2 + 11


def test_a_run_without_weights_or_entropy_says_so_once(script, capsys):
    watch = script("utils").Watch(8, 0.01)
    good = {"ESS": 4.0, "entropy": 1.0, "length": 2.0}
    for metrics in [good | {"ESS": 1.4}] * 9 + [good] + [good | {"ESS": 1.4}] * 9:
        watch(metrics)
    assert not capsys.readouterr().err
    for _ in range(30):
        watch({"ESS": 1.4, "entropy": 0.019, "length": 2.0})
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("ESS stays below 1.5 of 8:")
    assert lines[1].startswith("The entropy is gone:")
    for _ in range(30):
        watch({"entropy": 5.0})  # of a loss without weights, or a task of one step
    assert not capsys.readouterr().err


def test_several_choices_are_drawn_independently(script):
    logits = torch.tensor([0.2, 0.8, 0.5, 0.25, 0.25]).log()
    choices = script("tasks").Choices(logits, [2, 3])
    log_prob = choices.log_prob(torch.tensor([1, 2]))
    torch.testing.assert_close(log_prob, torch.tensor(0.8 * 0.25).log())
    assert choices.mode.tolist() == [1, 0]
    assert int(choices.sample((1000,))[:, 0].max()) == 1
    uniform = torch.full((5,), 0.0, requires_grad=True)
    entropy = script("tasks").Choices(uniform, [2, 3]).entropy()
    torch.testing.assert_close(entropy, torch.tensor(6.0).log())
    entropy.backward()
    assert uniform.grad.isfinite().all()


def test_compare_names_runs_that_have_not_finished(sweep, tmp_path, capsys):
    for loss in ("ecpo", "ment", "urex"):
        shutil.copytree(sweep / loss, tmp_path / loss)
    (tmp_path / "ment/summary.json").write_text('{"finished": false}')
    (tmp_path / "urex/summary.json").unlink()
    compare.main([str(tmp_path), "--metric", "expected_reward"])
    output = capsys.readouterr().out
    assert "| ecpo | 1 | 60 |" in output
    assert (tmp_path / "comparison.png").exists()
    named = [line for line in output.splitlines() if "not finished" in line]
    assert [Path(line.split()[-1]).name for line in named] == ["ment", "urex"]


@pytest.mark.slow  # one to four minutes
@pytest.mark.parametrize("env", ["bandit", "gym"])
def test_a_compiled_run_gives_the_metrics_of_a_run_that_is_not(tmp_path, env):
    """With trajectories of other lengths in each batch, where there are steps."""
    size = {"bandit": TINY, "gym": ("total_trajectories=96", "env=gym", "env.max_steps=40")}[env]
    for compiled in ("true", "false"):
        directory = tmp_path / compiled
        options = ("seed=5", f"compile={compiled}", *size, f"hydra.run.dir={directory}")
        process = run_script(tmp_path, ECPO, *options, afresh=True)
        assert process.returncode == 0, process.stderr
    metrics = read_metrics(tmp_path / "true")
    expected = read_metrics(tmp_path / "false")
    assert metrics.keys() == expected.keys()
    for name, column in metrics.items():
        assert column == pytest.approx(expected[name], rel=1e-3, abs=1e-5, nan_ok=True), name


@pytest.mark.slow  # two to five minutes
def test_groups_of_eight_learn_cartpole(tmp_path):
    options = ("env=gym", "form=paper", "seed=0", "evaluation.interval=10")
    run_ecpo(tmp_path, *options, f"hydra.run.dir={tmp_path}")
    returns = [value for value in read_metrics(tmp_path)["greedy_return"] if value == value]
    assert max(returns) >= 475, returns


def test_a_metric_that_a_run_does_not_have_is_refused(tmp_path, train):
    message = r"anneal_from\.metric and stop_when\.metric must be one of"
    for goal in (
        "anneal_from={metric:foo,at_least:1}",
        "stop_when={metric:foo,at_least:1,batches:2}",
    ):
        with pytest.raises(KeyError, match=message):
            train(tmp_path, goal)
        assert not (tmp_path / "metrics.csv").exists(), "it was refused before it began"


def test_distinct_solutions_are_counted(script):
    tasks = script("tasks")
    # (move, write, character) of two steps in each of four trajectories of two groups.
    one, other, silent = [[1, 1, 3], [1, 1, 2]], [[0, 1, 3], [1, 1, 2]], [[1, 0, 0], [1, 1, 2]]
    silent_again = [[1, 0, 4], [1, 1, 2]]  # the 4 is not written
    action = torch.tensor([[one, one, other, other], [one, silent, silent_again, [one[0]] * 2]])
    reward = torch.tensor([[[1.0, 1.0]] * 4, [[1.0, 1.0]] * 3 + [[2.0, 0.0]]])
    done = torch.tensor([False, True]).expand(2, 4, 2).clone()
    done[1, 3] = True  # ends with its first step
    reward[0, 3, 1] = -0.5  # fails
    is_first = torch.tensor([True, False])
    groups = TensorDict(
        {
            "action": action,
            "attainable": torch.full((2, 4, 2), 2.0),
            "collector": {"mask": ~done.roll(1, 2) | is_first},
            "next": {"reward": reward.unsqueeze(-1), "done": done.unsqueeze(-1)},
        },
        batch_size=[2, 4, 2],
    )
    assert tasks.is_solved(groups).tolist() == [[True, True, True, False], [True] * 4]
    assert tasks.attained(groups) == (7 * 2 + 0.5) / 16
    # First group: one (twice) and other; second: one, silent (twice), and the short one.
    assert tasks.distinct_solutions(groups) == (2 + 3) / 2
    groups["next", "reward"].zero_()
    assert tasks.distinct_solutions(groups) == 0
