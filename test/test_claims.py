"""What the pages say in numbers is what the committed results say: claims.yaml is the table."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_ecpo.modules import make_tanh_gaussian_actor

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "sota-implementations/results"
TEXT = (RESULTS / "claims.yaml").read_text()
CLAIMS = yaml.load(TEXT, yaml.BaseLoader)
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
QUOTING = [page for page in PAGES if "<!-- claim: " in page.read_text()]


@pytest.mark.parametrize("claim", CLAIMS)
def test_a_claim_is_what_the_results_say(study, claim):
    now = [study.claims.now(*entry) for entry in CLAIMS[claim].items()]
    assert now == list(CLAIMS[claim])


@pytest.mark.parametrize("page", QUOTING, ids=lambda page: page.name)
def test_a_page_says_what_it_quotes(study, page):
    for claim, text in study.claims.quotes(page.read_text()):
        lacking = [phrase for phrase in CLAIMS[claim] if not study.claims.is_in(phrase, text)]
        assert not lacking, f"{claim}: {text}"


def test_each_claim_is_quoted_and_written_once(study):
    quoted = {claim for page in QUOTING for claim, _ in study.claims.quotes(page.read_text())}
    assert quoted == set(CLAIMS)
    table = yaml.compose(TEXT)
    for entries in (table, *(claim for _, claim in table.value)):
        keys = [key.value for key, _ in entries.value]
        assert len(keys) == len(set(keys)), "YAML keeps the last of two entries of one name"


def test_a_claim_that_is_wrong_or_counts_wrongly_is_noticed(study):
    now = study.claims.now
    assert now("2 of 10", "1, 10") == "1 of 10"
    assert now("1,234 and -0.5", "[12345.6, [-0.04]]") == "12,346 and 0.0"
    assert now("TD3's 7 of pass@10", "8") == "TD3's 8 of pass@10"
    for expression, message in (("1", "more numbers"), ("1, 2, 3", "lacks")):
        with pytest.raises(ValueError, match=message):
            now("2 of 10", expression)
    with pytest.raises(ValueError, match="does not hold"):
        now("all of them", "1 > 2")


# ------------------------------------------- what results.md says of environments and policies


def test_an_ant_that_never_moves_has_990_to_1000():
    ant = gymnasium.make("Ant-v5")
    ant.reset(seed=0)
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = ant.step(np.zeros(8))
        total, ended = total + float(reward), terminated or truncated
    assert 990 < total < 1000


def test_what_a_humanoid_observes_drives_an_untrained_policy_to_the_ends_of_its_range():
    env = gymnasium.make("Humanoid-v5")
    env.reset(seed=0)
    env.action_space.seed(0)
    observations, rewards, episodes = [], 0.0, 0
    while len(observations) < 1_000:
        observation, reward, terminated, _, _ = env.step(env.action_space.sample())
        observations.append(observation)
        rewards += float(reward)
        if terminated:
            env.reset()
            episodes += 1
    assert 105 < rewards / episodes < 120
    seen = torch.tensor(np.array(observations), dtype=torch.float32)
    forces, others = seen[:, -78:].abs(), seen[:, :-78].abs()
    assert forces.max() > 1_000
    assert others.max() < 200
    torch.manual_seed(0)
    states = TensorDict(observation=seen, batch_size=[1_000])
    actions = Bounded(-0.4, 0.4, shape=(17,))
    for gain, lowest, highest in ((1.0, 20, 50), (0.01, 0, 1)):
        actor = make_tanh_gaussian_actor(348, actions, final_gain=gain)
        mean_before_tanh = actor.get_dist(states).base_dist.base_dist.loc
        assert lowest < mean_before_tanh.abs().max() < highest


@pytest.mark.parametrize("trace", sorted((RESULTS / "play").iterdir()), ids=lambda path: path.stem)
def test_traces_of_play_stand_on_the_page_as_they_are_committed(trace):
    assert f"```text\n{trace.read_text()}```" in (ROOT / "docs/results.md").read_text()
