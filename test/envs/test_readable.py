"""What any space of gymnasium becomes, and which are refused."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import GymWrapper, TransformedEnv

from torchrl_ecpo.envs import EpisodeReplay, readable

CHOICE = spaces.Discrete(2)
NUMBERS = spaces.Box(-1, 1, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (6, 5, 3), np.uint8)
PLAIN = spaces.Dict(a=spaces.Discrete(3), b=spaces.Box(0, 4, (2,)))
MIXED = spaces.Dict(a=spaces.Discrete(3, start=2), b=spaces.Box(0, 4, (1, 2), np.float64))


class Own(gym.Env):
    """Observes what it is given, and remembers the last action, which must be of its space."""

    def __init__(self, observations=NUMBERS, actions=CHOICE, observation=None):
        self.observation_space, self.action_space = observations, actions
        self.observation = observations.sample() if observation is None else observation

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.action = action
        return self.observation, 0.0, False, False, {}


@pytest.mark.parametrize(
    ("space", "observation", "expected"),
    [
        (spaces.Discrete(3), 1, [0, 1, 0]),
        (spaces.Discrete(3, start=5), 7, [0, 0, 1]),
        (spaces.MultiDiscrete([2, 3]), np.array([1, 0]), [0, 1, 1, 0, 0]),
        (spaces.MultiBinary((2, 2)), np.array([[0, 1], [1, 1]], np.int8), [0, 1, 1, 1]),
        (spaces.Box(0, 255, (2,), np.uint8), np.array([51, 255], np.uint8), [0.2, 1]),
        (spaces.Box(-2, 2, (1, 2), np.int64), np.array([[-2, 1]]), [0, 0.75]),
        (spaces.Box(0, 10**6, (1,), np.int64), np.array([300]), [300]),
        (spaces.Box(np.array([0, 3]), np.array([4, 3]), dtype=np.int64), np.array([3, 3]), [3, 3]),
        pytest.param(
            spaces.Box(-1, 1, (2, 1), np.float16),
            np.array([[1], [-1]], np.float16),
            [1, -1],
            marks=pytest.mark.filterwarnings("ignore:overflow"),  # gymnasium's
        ),
        (spaces.Box(-1, 1, (), np.float32), np.array(0.5, np.float32), [0.5]),
        (spaces.Text(2, charset="abcd"), "db", [0.75, 0.25]),
        (spaces.Tuple([spaces.Discrete(2), spaces.Discrete(3)]), (1, 2), [0, 1, 0, 0, 1]),
        (
            spaces.Dict(at=NUMBERS, kind=spaces.Discrete(2)),
            {"at": np.array([0.5, -1], np.float32), "kind": 0},
            [0.5, -1, 1, 0],
        ),
    ],
    ids=str,
)
def test_observations_become_a_vector_of_numbers(space, observation, expected):
    env = readable(Own(space, observation=observation))
    seen, _ = env.reset(seed=0)
    assert isinstance(env.observation_space, spaces.Box)
    assert env.observation_space.contains(seen)
    assert seen.dtype == np.float32
    assert seen.tolist() == pytest.approx(expected)


def test_pixels_stay_an_image_with_channels_first():
    image = IMAGE.sample()
    env = readable(Own(IMAGE, observation=image))
    assert env.observation_space == spaces.Box(0, 255, (3, 6, 5), np.uint8)
    assert (env.reset()[0] == image.transpose(2, 0, 1)).all()
    grey = readable(Own(spaces.Box(0, 255, (6, 5), np.uint8)))
    assert grey.observation_space.shape == grey.reset()[0].shape == (1, 6, 5)
    # TorchRL takes a last dimension of three for a drawing of the task.
    assert GymWrapper(env).reset()["observation"].dtype == torch.uint8


@pytest.mark.parametrize(
    ("space", "plain", "played", "expected"),
    [
        (spaces.Discrete(3, start=5), spaces.Discrete(3), 1, 6),
        (spaces.MultiDiscrete([3]), spaces.Discrete(3), 2, [2]),
        (spaces.MultiDiscrete([[2, 3]]), spaces.MultiDiscrete([2, 3]), [1, 2], [[1, 2]]),
        (spaces.MultiBinary(2), spaces.MultiDiscrete([2, 2]), [0, 1], [0, 1]),
        (spaces.Box(-1, 2, (2, 1)), spaces.Box(-1, 2, (2,)), [0.5, 1], [[0.5], [1]]),
        (
            spaces.Tuple([spaces.Discrete(2), spaces.MultiDiscrete([3, 2], start=[-1, 4])]),
            spaces.MultiDiscrete([2, 3, 2]),
            [1, 0, 1],
            (1, [-1, 5]),
        ),
        (
            spaces.Dict(a=spaces.Box(0, 1, (1,)), b=spaces.Box(-1, 2, (1, 1))),
            spaces.Box(np.array([0, -1], np.float32), np.array([1, 2], np.float32)),
            [0.5, -1],
            {"a": [0.5], "b": [[-1]]},
        ),
        (
            MIXED,
            spaces.Dict(
                action=spaces.Dict(choices=spaces.Discrete(3), numbers=spaces.Box(0, 4, (2,)))
            ),
            {"action": {"choices": 2, "numbers": [1, 4]}},
            {"a": 4, "b": [[1, 4]]},
        ),
    ],
    ids=str,
)
def test_plain_actions_are_arranged_as_the_task_has_them(space, plain, played, expected):
    own = Own(actions=space)
    env = readable(own)
    assert env.action_space == plain
    env.reset()
    env.step(played if isinstance(played, dict) else np.array(played))
    torch.testing.assert_close(
        spaces.flatten(space, own.action), spaces.flatten(space, _arrays(space, expected))
    )
    GymWrapper(env, categorical_action_encoding=True).rollout(3)


def _arrays(space, action):
    if isinstance(space, spaces.Dict):
        return {key: _arrays(part, action[key]) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_arrays(*each) for each in zip(space, action, strict=True))
    return np.array(action, space.dtype)


def test_plain_spaces_are_left_as_they_are():
    for name in ("CartPole-v1", "Pendulum-v1", "Acrobot-v1"):
        env = gym.make(name)
        assert readable(env) is env


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observations": spaces.Sequence(NUMBERS)}, "Own observes Sequence.*TransformObservation"),
        ({"observations": spaces.Dict(a=spaces.Sequence(NUMBERS))}, "Own observes Dict"),
        ({"observations": spaces.Graph(NUMBERS, None)}, "Own observes Graph"),
        ({"observations": gym.Space((2,), np.float32), "observation": 0}, "Own observes .*Space"),
        ({"observations": spaces.Dict(a=IMAGE, b=NUMBERS)}, "image among.*FilterObservation"),
        ({"actions": spaces.Text(3)}, "takes actions of Text.*TransformAction"),
        ({"actions": spaces.Tuple([spaces.Graph(NUMBERS, None)])}, "takes actions of Graph"),
        ({"actions": spaces.Sequence(NUMBERS)}, "takes actions of Sequence"),
        ({"actions": spaces.OneOf([NUMBERS, NUMBERS])}, "takes actions of OneOf"),
        ({"actions": spaces.Box(-np.inf, 1, (2,))}, "takes actions without bounds"),
        ({"actions": spaces.Box(0, 4, (2,), np.int64)}, "takes actions of integers in a box"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        readable(Own(**options))


def test_what_is_no_environment_is_refused():
    with pytest.raises(TypeError, match="env must be an Env, got str"):
        readable("CartPole-v1")  # pyright: ignore


def test_minigrid_is_read_with_its_mission():
    pytest.importorskip("minigrid")
    env = readable(gym.make("minigrid:MiniGrid-GoToDoor-5x5-v0"))
    seen, _ = env.reset(seed=0)
    assert seen.dtype == np.float32
    letters = seen[7 * 7 * 3 :].reshape(96, 28)
    mission = "".join((*map(chr, range(97, 123)), " ", ",")[i] for i in letters.argmax(1))
    assert mission.startswith("go to the ")


def test_a_mission_that_is_always_the_same_is_not_read():
    pytest.importorskip("minigrid")
    env = gym.make("minigrid:MiniGrid-DoorKey-5x5-v0")
    seen, _ = readable(env).reset(seed=0)
    assert seen.dtype == np.float32
    assert seen.tolist() == env.reset(seed=0)[0]["image"].flatten().tolist()


@pytest.mark.parametrize("wrap", [readable, lambda task: task])
def test_an_episode_of_choices_and_numbers_can_be_played_again(wrap):
    tasks = [Own(actions=MIXED if wrap is readable else PLAIN) for _ in range(2)]
    env, other = (
        TransformedEnv(GymWrapper(wrap(task), categorical_action_encoding=True), EpisodeReplay())
        for task in tasks
    )
    env.rollout(3)
    other.load_state_dict(env.state_dict())
    played, again = (spaces.flatten(task.action_space, task.action) for task in tasks)
    assert played.tolist() == again.tolist()
