"""The actor-critic script, started as a user would start it, and what it is built from.

What does not depend on the command line is run in the process of the tests.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest
import torch
from gymnasium.envs.classic_control import PendulumEnv
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from processes import run_script
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.envs import GymEnv, GymWrapper
from torchrl.objectives import SACLoss

from torchrl_ecpo.experiment import compile_module, read_metrics
from torchrl_ecpo.experiment._videos import greedy_episodes
from torchrl_ecpo.modules import DenseNetwork

SCRIPT = Path(__file__).parents[1] / "sota-implementations/ecac"
TINY = (
    "total_frames=240",
    "log_interval=80",
    "evaluation.interval=160",
    "evaluation.episodes=1",
    "collector.init_random_frames=80",
    "hidden_sizes=[16,16]",
    "replay_buffer.batch_size=32",
    "updates_per_frame=0.25",
    "loss.num_actor_states=16",
)
LOSSES = ("ecac", "pmd_ac", "mpo", "sac", "sac_score", "tqc", "crossq", "td3", "ddpg")


def start(directory, *options):
    return run_script(directory, SCRIPT / "ecac.py", *options, afresh="compile=true" in options)


def tiny(overrides):
    """The settings of a short run; the number of actor states is ECAC's own."""
    is_ecac = not any(override.startswith("loss=") for override in overrides)
    return TINY if is_ecac else TINY[:-1]


def configure(overrides):
    with initialize_config_dir(str(SCRIPT / "config"), version_base="1.3"):
        return compose("config", overrides)


@pytest.fixture
def beside_ecac(beside):
    """Imports what is beside the script."""
    return partial(beside, "ecac")


@pytest.fixture
def utils(beside_ecac):
    return beside_ecac("utils")


@pytest.fixture
def train(run_here):
    """Runs the script in this process, in a directory."""

    def train(directory, *overrides):
        run_here(directory, "ecac", *tiny(overrides), *overrides)
        return read_metrics(directory)

    return train


def reproducible(metrics):
    """All but speed; as text, in which NaN equals NaN."""
    return {name: str(column) for name, column in metrics.items() if name != "steps_per_second"}


SWEPT = ("ecac", "sac", "td3")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Some losses, by one start of the script."""
    directory = tmp_path_factory.mktemp("sweep")
    where = (f"hydra.sweep.dir={directory}", "hydra.sweep.subdir=${loss.name}")
    options = (f"loss={','.join(SWEPT)}", "seed=3", *TINY[:-1])
    process = start(directory, "--multirun", *options, *where)
    assert process.returncode == 0, process.stderr
    return directory


@pytest.mark.parametrize("loss", SWEPT)
def test_a_sweep_leaves_a_directory_for_each_run(sweep, loss):
    check_run(read_metrics(sweep / loss))
    assert json.loads((sweep / loss / "summary.json").read_text())["finished"] is True
    assert OmegaConf.load(sweep / loss / "config.yaml").loss.name == loss
    assert (sweep / loss / "curve.png").exists()


@pytest.mark.parametrize("loss", [loss for loss in LOSSES if loss not in SWEPT])
def test_every_other_loss_trains_on_pendulum(tmp_path, train, loss):
    check_run(train(tmp_path, f"loss={loss}", "seed=3"))


def test_batch_renormalisation_is_by_the_running_moments(beside_ecac):
    """After the warm-up, where no bound is reached, however long ago: Ioffe 2017, Eq. 1."""
    layer = beside_ecac("crossq").Renorm(2, warmup_steps=1)
    for _ in range(4):
        layer(torch.randn(50, 2))
    mean, scale = layer.running_mean.clone(), (layer.running_var + layer.eps).sqrt()
    batch = torch.randn(50, 2)
    torch.testing.assert_close(layer(batch), (batch - mean) / scale)


def check_run(metrics):
    assert metrics["step"] == [80, 160, 240]
    losses = [name for name in metrics if name.startswith("loss_")]
    assert len(losses) >= 2
    for name in losses:
        assert math.isnan(metrics[name][0]), "no updates while actions are random"
        assert all(map(math.isfinite, metrics[name][1:]))
    assert list(map(math.isnan, metrics["evaluation_return"])) == [True, False, True]
    assert -2000 < metrics["evaluation_return"][1] < 0
    # The only episode that ended, after 200 steps; the time limit is none that bootstrapping sees.
    assert list(map(math.isnan, metrics["return"])) == [True, True, False]


def test_the_same_seed_gives_the_same_run_and_another_another(sweep, tmp_path):
    options = ("--multirun", "loss=sac", "seed=3,4", *TINY[:-1])
    where = (f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=${seed}")
    process = start(tmp_path, *options, *where)
    assert process.returncode == 0, process.stderr
    again, other = read_metrics(tmp_path / "3"), read_metrics(tmp_path / "4")
    assert reproducible(again) == reproducible(read_metrics(sweep / "sac"))
    assert other["evaluation_return"][1] != again["evaluation_return"][1]
    assert other["return"][2] != again["return"][2]


@pytest.mark.slow  # one to four minutes
def test_a_compiled_run_gives_the_metrics_of_a_run_that_is_not(sweep, tmp_path):
    options = ("loss=ecac", "seed=3", "compile=true", f"hydra.run.dir={tmp_path}")
    process = start(tmp_path, *TINY[:-1], *options)
    assert process.returncode == 0, process.stderr
    for name in ("policy", "update"):
        assert re.search(rf"first call of the {name} compiles it", process.stdout)
    metrics, expected = read_metrics(tmp_path), read_metrics(sweep / "ecac")
    assert metrics.keys() == expected.keys()
    for name in metrics.keys() - {"steps_per_second"}:
        assert metrics[name] == pytest.approx(expected[name], 1e-3, 1e-5, nan_ok=True), name


def test_evaluation_does_not_disturb_training(sweep, tmp_path, train):
    often = train(tmp_path, "loss=td3", "seed=3", "evaluation.interval=80")
    seldom = read_metrics(sweep / "td3")
    for name in ("return", "loss_actor", "loss_qvalue"):
        assert str(often[name]) == str(seldom[name])


@pytest.mark.parametrize(
    "options",
    [
        (
            *("env=hopper", "replay_buffer.storage=memmap", "critic=layer_norm"),
            *("loss.projection=gradient", "loss.width_entropy=0.4"),
        ),
        (
            *("env=dm_control", "env.name=pendulum", "env.task=swingup"),
            *("loss=sac", "loss.width_entropy=0.4"),
        ),
        (
            *("loss.reference_interval=5", "loss.projection=paper"),
            *("loss.value_network=true", "loss.target_kl=null"),
            "loss.tau={schedule:linear,start:0.2,end:0.1,duration:160}",
        ),
    ],
    ids=" ".join,
)
def test_tasks_and_ablations_run(tmp_path, train, options):
    if "env=hopper" in options or "env=dm_control" in options:
        pytest.importorskip("mujoco")
    metrics = train(tmp_path, *options)
    assert metrics["step"][-1] == 240
    assert math.isfinite(metrics["loss_actor"][-1])
    if any("schedule" in option for option in options):
        # Counted from the first update on: 160 frames are left after the random ones.
        assert metrics["tau"][1:] == pytest.approx([0.15, 0.1], abs=0.01)


def test_a_schedule_of_what_is_learned_is_refused(tmp_path, train):
    schedule = "loss.tau={schedule:linear,start:0.2,end:0.1,duration:160}"
    with pytest.raises(ValueError, match=r"tau is learned\. Build the loss without target_kl"):
        train(tmp_path, schedule)


@pytest.mark.slow
def test_workers_run(tmp_path):
    process = start(
        tmp_path, *TINY[:-1], f"hydra.run.dir={tmp_path}", "collector=multi_sync", "loss=sac"
    )
    assert process.returncode == 0, process.stderr
    metrics = read_metrics(tmp_path)
    assert metrics["step"][-1] == 240
    assert math.isfinite(metrics["loss_actor"][-1])


def test_lengths_that_fit_no_interval_are_run_to_the_end(tmp_path, train):
    """Rows are written when one is due, when the policy is evaluated, and at the end."""
    odd = ("total_frames=250", "log_interval=70", "evaluation.interval=100")
    metrics = train(tmp_path, "loss=sac", *odd)
    assert metrics["step"] == [72, 104, 144, 200, 216, 256]  # in batches of 8
    evaluated = [x == x for x in metrics["evaluation_return"]]
    assert evaluated == [False, True, False, True, False, False]


def test_without_entropy_is_one_option(utils, build):
    """Neither a bonus nor a temperature that is learned, and the same numbers as in more words."""
    config, _, loss_module = build("loss.tau_prime=0")
    _, _, same = build("loss.tau_prime=0", "loss.target_entropy=null")
    assert "log_tau_prime" not in dict(loss_module.named_parameters())
    utils.make_optimizer(config.optim, loss_module)  # whose rate is there for nothing
    batch = random_transitions()
    losses = []
    for each in (loss_module, same):
        torch.manual_seed(0)
        losses.append(each(batch.clone()).detach().to_dict())
    assert losses[0]["tau_prime"] == 0
    torch.testing.assert_close(*losses)


@pytest.mark.parametrize("text", ["total_trajectories: 10", "total_completions: 10"])
def test_play_refuses_runs_of_other_scripts(tmp_path, beside_ecac, capsys, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(SystemExit):
        beside_ecac("play").main([str(tmp_path)])
    assert f"error: {tmp_path} is no run of ecac.py.\n" in capsys.readouterr().err


def test_play_shows_what_a_run_has_learned(tmp_path, beside_ecac, train, capsys, monkeypatch):
    # A hundredth of the pixels, which take most of the time.
    monkeypatch.setattr(
        PendulumEnv, "screen_dim", property(lambda _: 50, lambda *_: None), raising=False
    )
    train(tmp_path, "loss=sac")
    capsys.readouterr()
    beside_ecac("play").main([str(tmp_path), "--episodes", "2"])
    first, second, mean, drawn = capsys.readouterr().out.splitlines()
    returns = [
        float(line.removeprefix("return ").removesuffix(", 200 steps")) for line in (first, second)
    ]
    assert float(mean.removeprefix("mean return ")) == pytest.approx(sum(returns) / 2, rel=1e-4)
    assert drawn == f"the first one is drawn in {tmp_path / 'episode.gif'}"
    with Image.open(tmp_path / "episode.gif") as video:
        assert video.n_frames > 100  # equal ones are shown for longer


CARTPOLE = ("env=gym", "env.name=CartPole-v1")


def test_one_discrete_action_has_a_loss_of_its_own(tmp_path, train):
    process = start(tmp_path, *TINY[:-1], f"hydra.run.dir={tmp_path}", *CARTPOLE)
    assert process.returncode == 0, process.stderr
    assert OmegaConf.load(tmp_path / "config.yaml").loss.name == "discrete_ecac"
    others = (
        train(tmp_path / loss, *CARTPOLE, f"loss={loss}")
        for loss in ("discrete_pmd_ac", "discrete_sac")
    )
    for metrics in (read_metrics(tmp_path), *others):
        assert metrics["step"][-1] == 240
        assert all(map(math.isfinite, metrics["loss_actor"][1:]))
        assert 0.6 < metrics["entropy"][-1] <= math.log(2) + 1e-6


def test_a_game_of_minatar_and_fewer_updates_than_frames(tmp_path, train):
    pytest.importorskip("minatar")
    game = ("env=minatar", "env.name=MinAtar/Freeway-v1", "loss=discrete_ecac")
    assert configure(game[:2]).updates_per_frame == 0.25
    metrics = train(tmp_path, *game)
    assert metrics["step"][-1] == 240
    assert all(map(math.isfinite, metrics["loss_actor"][1:]))
    (progress,) = tmp_path.glob("checkpoints/*/components/*-progress/state.pt")
    assert torch.load(progress)["updates"] == (240 - 80) / 4


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env=pendulum", "env.name=Ant-v5"], "env.name=Ant-v5: the runs would be named pendulum"),
        (["env=gym", "env.name=Chess-v0"], "env.name=Chess-v0 is no task of gymnasium"),
        (["env=gym", "env.name=CartPole-v1"], "loss=ecac does not go with env.name=CartPole-v1.*"),
        (["env=pendulum", "loss=discrete_ecac"], "loss=discrete_ecac does not go with"),
        (["env=dm_control", "env.task=fly"], "env.name=cheetah env.task=fly cannot be made"),
        (["loss=crossq", "critic=layer_norm"], "critic=layer_norm does not go with loss=crossq"),
        (["loss=sac", "loss.target_entropy=null"], "target_entropy=null does not go with loss=sac"),
        (
            ["env=cartpole", "loss=discrete_ecac", "loss.exploration=0.1"],
            "loss.exploration is noise",
        ),
        (
            ["env=cartpole", "loss=discrete_sac", "loss.value_network=true"],
            "loss.value_network=true does not go with loss=discrete_sac",
        ),
        (["loss=td3", "loss.value_network=true"], "value_network=true does not go with loss=td3"),
        (["loss=sac_score", "loss.value_network=false"], "loss=sac_score needs a value network"),
        (["~optim.lr.log_tau"], "optim.lr must have a learning rate for each of"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_bad_options_end_with_a_clear_message(utils, overrides, message):
    config = configure([*tiny(overrides), *overrides])
    with pytest.raises(ValueError, match=message):  # noqa: PT012 - the script's first steps
        utils.check_config(config, overrides)
        env = utils.make_environment(config, seed=0)
        loss_module = utils.make_loss(config, utils.make_actor(config, env), env)
        utils.make_optimizer(config.optim, loss_module)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("env=gym env.name=CartPole-v1 seed=1", ["loss=discrete_ecac"]),
        ("env=gym env.name=CartPole-v1 loss=pmd_ac", []),
        ("env=gym env.name=Pendulum-v1", []),
        ("env=gym env.name=Chess-v0", []),
        ("env=gym", []),
        ("env=minatar env.name=MinAtar/Breakout-v1", ["loss=discrete_ecac"]),
        ("env=acrobot,cartpole", ["loss=discrete_ecac"]),
        ("env=acrobot,pendulum", []),
        ("env=pendulum", []),
    ],
)
def test_the_loss_is_that_of_the_actions_unless_it_is_given(beside_ecac, options, expected):
    assert beside_ecac("choice").chosen_loss(options.split()) == expected


def test_pixels_are_read_by_networks_of_convolutions(utils, monkeypatch):
    class Screen(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (9, 10, 3), "uint8")
        action_space = gym.spaces.Discrete(3)
        spec = None

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 1.0, False, False, {}

    monkeypatch.setattr(gym, "make", lambda name, **options: Screen())
    config = configure(["env=gym", "env.name=Screen", "loss=discrete_ecac"])
    env = utils.make_environment(config, seed=0)
    actor = utils.make_actor(config, env)
    loss_module = utils.make_loss(config, actor, env)
    utils.make_updater(config, loss_module)
    steps = env.rollout(4, actor).select(*loss_module.in_keys, strict=False)
    assert {*steps.keys()} == {"observation", "action", "next"}
    losses = loss_module(steps)
    (losses["loss_actor"] + losses["loss_qvalue"]).backward()
    for name, parameter in loss_module.named_parameters():
        assert name.startswith("log_tau") or parameter.grad.isfinite().all()
    Screen.action_space = gym.spaces.Box(-1, 1, (2,))
    for loss in ("crossq", "sac_score"):
        with pytest.raises(ValueError, match=f"loss={loss} does not read pixels"):
            utils.check_config(configure(["env=gym", "env.name=Screen", f"loss={loss}"]))


def test_a_missing_simulator_is_named_with_its_extra(utils, monkeypatch):
    def fail(name, **options):
        raise gym.error.DependencyNotInstalled("No mujoco.")

    monkeypatch.setattr(gym, "make", fail)
    config = configure(["env=gym", "env.name=Ant-v5"])
    with pytest.raises(ModuleNotFoundError, match=r"Ant-v5 .* pip install '\.\[mujoco\]'"):
        utils.make_environment(config, seed=0)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ModuleNotFoundError("No pygame."), r"pendulum: pygame\. pip install '\.\[video\]'"),
        (RuntimeError("No display."), r"pendulum: pygame\. MuJoCo .* MUJOCO_GL .* egl"),
    ],
)
def test_a_video_that_cannot_be_drawn_says_what_to_install(utils, monkeypatch, error, message):
    class Env(GymWrapper):
        def __init__(self, env, *, from_pixels, **options):
            if from_pixels:
                raise error from ImportError("pygame")
            super().__init__(env)

    monkeypatch.setattr("torchrl_ecpo.experiment._tasks.GymWrapper", Env)
    config = configure(["evaluation.video=true"])
    with pytest.raises(ValueError, match=f"There is no video of {message}"):
        utils.make_evaluation_environment(config)
    utils.make_environment(config, seed=0)  # training draws nothing


def test_noise_is_in_the_unit_of_each_component(utils):
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 1.0]), (2,))
    config, env = (
        OmegaConf.create({"exploration": 0.2}),
        SimpleNamespace(action_spec_unbatched=spec),
    )
    actor = TensorDictModule(torch.tanh, in_keys=["observation"], out_keys=["action"])
    noise = utils.make_policy(config, actor, env)[-1]
    torch.testing.assert_close(noise.std, torch.tensor([0.2, 0.1]))


def test_workers_of_different_seeds_share_no_data(utils):
    starts = [
        utils._make_worker_environment(configure([f"seed={seed}"]), worker).rollout(1)
        for seed in (0, 1)
        for worker in (0, 1)
    ]
    for key in ("observation", "action"):
        assert len({str(start[key].tolist()) for start in starts}) == 4, key


def test_a_video_of_the_first_episode_is_saved(utils, tmp_path, monkeypatch):
    """Without a renderer: an environment is asked for rollouts with pixels only."""

    class Env:
        def rollout(self, max_steps, policy):
            pixels = torch.randint(256, (4, 8, 6, 3), dtype=torch.uint8)
            rewards = torch.arange(4.0).unsqueeze(-1)
            following = {"episode_reward": rewards, "pixels": pixels}
            return TensorDict({"pixels": pixels, "next": following}, [4])

    monkeypatch.chdir(tmp_path)
    config = OmegaConf.create({"episodes": 2, "video": True})
    assert utils.evaluate(Env(), None, config, 40) == {"evaluation_return": 3.0}
    with Image.open("evaluation_40.gif") as video:
        assert (video.n_frames, video.size) == (4, (6, 8))
    kept = [[*episode.keys(True, True)] for episode in greedy_episodes(Env(), None, 2)]
    reward = ("next", "episode_reward")
    assert [set(keys) for keys in kept] == [{"pixels", reward}, {reward}]


@pytest.mark.parametrize(("name", "ends_early"), [("Pendulum-v1", False), ("Hopper-v5", True)])
def test_time_limits_are_truncations(utils, name, ends_early):
    if name == "Hopper-v5":
        pytest.importorskip("mujoco")
    config = configure(["env=gym", f"env.name={name}"])
    last = utils.make_environment(config, seed=0).rollout(1000)[-1]["next"]
    assert last["done"].item()
    assert last["terminated"].item() is ends_early
    assert last["truncated"].item() is not ends_early
    assert last["observation"].dtype == torch.float32


@pytest.fixture
def build(utils):
    """Builds environment, actor and loss (with its updater), always with the same weights."""

    def build(*overrides):
        torch.manual_seed(0)
        config = configure(["hidden_sizes=[16,16]", *overrides])
        env = utils.make_environment(config, seed=0)
        actor = utils.make_actor(config, env)
        loss_module = utils.make_loss(config, actor, env)
        utils.make_updater(config, loss_module)
        return config, actor, loss_module

    return build


def random_transitions():
    """256 of Pendulum's, none of which ends an episode."""
    never = torch.zeros(256, 1, dtype=torch.bool)
    torch.manual_seed(0)
    following = {"observation": torch.randn(256, 3), "reward": torch.randn(256, 1)}
    following |= {"done": never, "terminated": never}
    now = {"observation": torch.randn(256, 3), "action": torch.rand(256, 1)}
    return TensorDict(now | {"next": following}, [256])


@pytest.mark.parametrize("loss", ["ecac", "pmd_ac"])
def test_the_way_q_networks_are_called_changes_no_number(build, monkeypatch, loss):
    def losses_and_gradients():
        _, _, loss_module = build("hidden_sizes=[48,48]", f"loss={loss}")
        losses = loss_module(random_transitions())
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        return losses.detach().to_dict(), [each.grad for each in loss_module.parameters()]

    ours = losses_and_gradients()
    monkeypatch.delattr(DenseNetwork, "each")
    torch.testing.assert_close(ours, losses_and_gradients())


def test_an_update_that_leaves_the_policy_is_the_same_for_q(utils, build):
    def loss_of_q_and_gradients(*, with_policy):
        _, _, loss_module = build("loss=td3")
        losses = utils.compute_losses(loss_module, random_transitions(), with_policy)
        assert ("loss_actor" in losses) is with_policy
        losses["loss_qvalue"].backward()
        gradients = [parameter.grad for parameter in loss_module.qvalue_network_params.parameters()]
        return losses["loss_qvalue"].detach(), gradients

    whole = loss_of_q_and_gradients(with_policy=True)
    torch.testing.assert_close(loss_of_q_and_gradients(with_policy=False), whole, rtol=0, atol=0)


def test_a_compiled_update_that_leaves_the_policy_leaves_it(utils, build):
    """Compiled, what a loss does not need has a gradient of 0, where eagerly it has none."""
    from ecac import descend, total

    def weights(*, is_compiled):
        config, actor, loss_module = build("loss=td3")
        optimizer = utils.make_optimizer(config.optim, loss_module)
        policies = []
        for count in range(1, 5):
            losses, is_due = loss_module(random_transitions()), count % 2 == 0
            loss = total(losses, is_due)
            if is_compiled:
                loss = loss + 0 * sum(parameter.sum() for parameter in actor.parameters())
            descend(loss, optimizer, kept=None if is_due else actor)
            policies.append([parameter.detach().clone() for parameter in actor.parameters()])
        return policies

    policies = weights(is_compiled=False)
    moved = [not torch.equal(a[0], b[0]) for a, b in itertools.pairwise(policies)]
    assert moved == [True, False, True]
    torch.testing.assert_close(weights(is_compiled=True), policies, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["ecac", "sac", "crossq"])
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_an_update_is_compiled_once(build, loss):
    """Without vmap TorchRL's losses are compiled at each call, until dynamo gives up."""
    *_, loss_module = build(f"loss={loss}", "compile=true")
    batch = random_transitions().select(*loss_module.in_keys)  # as the script
    compile_module(loss_module, "update")
    loss_module(batch.copy())
    with torch.compiler.set_stance("fail_on_recompile"):
        loss_module(batch.copy())


def test_adam_has_a_group_for_each_learning_rate(utils, build):
    config, _, loss_module = build()
    rates = {
        parameter: group["lr"]
        for group in utils.make_optimizer(config.optim, loss_module).param_groups
        for parameter in group["params"]
    }
    for name, parameter in loss_module.named_parameters():
        assert rates[parameter] == config.optim.lr[name.split(".")[0].removesuffix("_params")]
    assert len(rates) == len(list(loss_module.parameters()))


def test_on_humanoid_ecac_s_policy_alone_starts_small_and_learns_slower(utils):
    env = utils.make_environment(configure([]), seed=0)  # whichever
    for name, rate, gain in (("pendulum", 1e-3, 1.0), ("ant", 1e-3, 1.0), ("humanoid", 3e-4, 0.01)):
        config = configure([f"env={name}"])
        assert config.optim.lr.actor_network == rate
        assert next(iter(utils.make_actor(config, env))).final_gain == gain
    for loss in set(LOSSES) - {"ecac"}:
        there, elsewhere = (
            configure([f"env={env}", f"loss={loss}"]) for env in ("humanoid", "ant")
        )
        assert there.loss == elsewhere.loss


@pytest.mark.parametrize(("new", "share"), [(8, 0.25), (6, 0.2), (25, 0.28), (50, 0.58), (8, 1)])
def test_fractions_of_updates_add_up(utils, new, share):
    due = [utils.updates_due(frames, new, share) for frames in range(new, 100 * new + 1, new)]
    assert sum(due) == round(100 * new * share)
    assert max(due) - min(due) <= 1


def test_a_game_goes_on_as_it_would_have(utils):
    """Its ball and what repeats actions are random by a generator that gymnasium does not know."""
    pytest.importorskip("minatar")
    config = configure(["env=minatar"])
    torch.manual_seed(0)
    env, other = (utils.make_environment(config, seed=seed) for seed in (1, 2))
    for _ in range(6):
        last = env.rollout(5, break_when_any_done=True)[-1]
    other.load_state_dict(env.state_dict())
    observations = []
    for each in (env, other):
        torch.manual_seed(1)
        after = each.rollout(50, auto_reset=False, tensordict=last["next"].exclude("reward"))
        observations.append(after["next", "observation"])
    assert len(observations[0]) > 1
    assert torch.equal(*observations)


def test_every_asks_once_an_interval(utils):
    every = utils.Every(10)
    assert [count for count in range(4, 60, 4) if every(count)] == [12, 20, 32, 40, 52]


def test_the_score_function_gradient_is_the_reparameterised_one_in_expectation(utils):
    torch.manual_seed(0)
    spec = GymEnv("Pendulum-v1").action_spec
    networks = (
        utils.make_tanh_gaussian_actor(3, spec, hidden_sizes=[4]),
        utils.make_qvalue_network(3, 1, hidden_sizes=[4]),
        utils.make_value_network(3, hidden_sizes=[4]),
    )
    batch = TensorDict({"observation": torch.randn(1, 3).expand(200_000, 3)}, [200_000])
    options = {"num_qvalue_nets": 1, "loss_function": "l2"}
    parameters = list(networks[0].parameters())
    losses = [make(*networks, **options) for make in (SACLoss, utils.ScoreSACLoss)]
    losses[1].qvalue_network_params.data.copy_(losses[0].qvalue_network_params.data)
    gradients = [
        torch.autograd.grad(loss_module.actor_loss(batch)[0], parameters) for loss_module in losses
    ]
    torch.testing.assert_close(*gradients, rtol=0.02, atol=0.01)


def test_width_sac_changes_the_policy_s_width_alone(utils):
    """With phi = 1 nothing; with less, alpha (1 - phi) log sigma is added."""
    torch.manual_seed(0)
    spec = GymEnv("Pendulum-v1").action_spec
    actor = utils.make_tanh_gaussian_actor(3, spec, hidden_sizes=[4])
    qvalue = utils.make_qvalue_network(3, 1, hidden_sizes=[4])
    batch = TensorDict({"observation": torch.randn(50, 3)}, [50])
    options = {"loss_function": "l2", "alpha_init": 0.5}
    losses = [
        SACLoss(actor, qvalue, **options),
        utils.WidthSACLoss(actor, qvalue, **options),
        utils.WidthSACLoss(actor, qvalue, **options, width_entropy=0.4),
    ]
    values = []
    for loss_module in losses:
        loss_module.qvalue_network_params.data.copy_(losses[0].qvalue_network_params.data)
        torch.manual_seed(1)
        values.append(loss_module.actor_loss(batch)[0])
    log_scale = actor[0](batch.clone())["scale"].log().sum(-1).mean()
    values.append(values[0] + 0.5 * (1 - 0.4) * log_scale)
    same, narrower, expected = (
        torch.autograd.grad(value - values[0], list(actor.parameters()), retain_graph=True)
        for value in values[1:]
    )
    torch.testing.assert_close(narrower, expected)
    assert not any(gradient.any() for gradient in same)


@pytest.mark.slow  # some three minutes
def test_ecac_swings_the_pendulum_up(tmp_path):
    process = start(tmp_path, "env=pendulum", "seed=0", f"hydra.run.dir={tmp_path}")
    assert process.returncode == 0, process.stderr
    returns = [value for value in read_metrics(tmp_path)["evaluation_return"] if value == value]
    assert returns[-1] > -300, returns
