"""Completions of a language model in the losses over groups, beside TorchRL's own."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from tensordict import lazy_stack
from torch import nn
from torch.testing import assert_close

pytest.importorskip("transformers")

import tiny_llm as tiny
from tiny_llm import END, PAD, PROMPTS, RESPONSES, REWARDS, dense, ragged
from torchrl.data import LazyStackStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import PromptGroupSampler
from torchrl.modules.distributions import LLMMaskedCategorical
from torchrl.objectives.llm import GRPOLoss as TorchRLGRPOLoss
from torchrl.objectives.llm import MCAdvantage
from transformers import GPT2Config, GPT2LMHeadModel, OPTConfig, OPTForCausalLM

from torchrl_ecpo import (
    ECPOLoss,
    GRPOLoss,
    MENTLoss,
    PMDLoss,
    REPSLoss,
    RLOOLoss,
    SquaredPMDLoss,
    TPOLoss,
    TrustPCLLoss,
    UREXLoss,
)
from torchrl_ecpo.functional import standardised
from torchrl_ecpo.llm import check_sampler, record_log_probs

LOSSES = (
    *(ECPOLoss, PMDLoss, TPOLoss, UREXLoss, MENTLoss, RLOOLoss, GRPOLoss, REPSLoss),
    SquaredPMDLoss,
)
pytestmark = pytest.mark.filterwarnings("ignore:size_average and reduce:UserWarning")
layouts = pytest.mark.parametrize("pad_output", [False, True], ids=["ragged", "dense"])
GROUPS = [[0, 2, 5], [1, 3, 4]]  # rows of PROMPTS with the same one
IN_GROUPS = [0, 2, 5, 1, 3, 4]
FULL, PROMPT, RECORDED = ("tokens", "full"), ("tokens", "prompt"), ("log_probs", "full")
REWARD = ("next", "reward")


@pytest.fixture(scope="module")
def model():
    return tiny.make_model()


def make(model, pad_output=False, **options):
    batch = ragged(model, **options)
    return tiny.make_actor(model, pad_output=pad_output), dense(batch) if pad_output else batch


def gradients(loss, model):
    found = torch.autograd.grad(loss.sum(), list(model.parameters()), allow_unused=True)
    return [x for x in found if x is not None]


# ------------------------------------------------------------------------------- the numbers


@layouts
def test_sums_are_those_of_the_responses(model, pad_output):
    actor, batch = make(model, pad_output)
    groups = RLOOLoss(actor)._read(batch)
    for g, members in enumerate(GROUPS):
        for k, i in enumerate(members):
            expected = tiny.log_probs_by_hand(model, PROMPTS[i], RESPONSES[i]).sum()
            assert_close(groups.log_prob[g, k], expected, rtol=1e-4, atol=1e-4)
            assert groups.returns[g, k] == REWARDS[i]
            assert groups.num_steps[g, k] == len(RESPONSES[i])
    assert_close(groups.log_prob, groups.behaviour_log_prob, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.__name__)
def test_every_loss_takes_completions(model, loss):
    actor, batch = make(model)
    keys = sorted(map(str, batch.keys(True, True)))
    losses = loss(actor)(batch)
    assert abs(losses["kl_reference_policy"]) < 1e-4
    assert losses["return"] == sum(REWARDS) / 6
    assert any(gradient.any() for gradient in gradients(losses["loss_actor"], model))
    assert sorted(map(str, batch.keys(True, True))) == keys  # nothing is written
    each = loss(actor, reduction="none")(batch)["loss_actor"]
    assert_close(each.mean(), losses["loss_actor"])


def test_ecpo_by_hand(model):
    """Weights softmax(return / tau) of 3 completions; the loss is -sum of w log pi."""
    actor, batch = make(model)
    losses = ECPOLoss(actor, tau=1.0, tau_prime=0.0, reduction="none")(batch)
    for g, members in enumerate(GROUPS):
        weights = torch.tensor([REWARDS[i] for i in members]).softmax(0)
        log_prob = [tiny.log_probs_by_hand(model, PROMPTS[i], RESPONSES[i]).sum() for i in members]
        assert_close(losses["loss_actor"][g], -(weights * torch.stack(log_prob)).sum())


@layouts
@pytest.mark.parametrize("aggregation", ["prompt_mean", "token_mean"])
def test_grpo_is_torchrls(model, pad_output, aggregation):
    """Given the same advantages, the values and the gradients are equal, clipped ratios included.

    TorchRL's mean over tokens is of the batch, ours of a group: of one group they are the same.
    """
    actor, batch = make(model, pad_output, noise=0.3)
    if aggregation == "token_mean":
        batch = batch[GROUPS[1]]
        batch = dense(ragged(model, 0.3))[GROUPS[1]] if pad_output else batch
    loss_module = GRPOLoss(actor, aggregation=aggregation)
    ours = loss_module(batch)
    groups = loss_module._read(batch)
    order = [0, 1, 2] if aggregation == "token_mean" else IN_GROUPS
    advantage = torch.empty(len(batch))
    advantage[order] = standardised(groups.returns).flatten()
    batch["advantage"] = advantage.view(-1, 1, 1)
    theirs = TorchRLGRPOLoss(actor, aggregation=aggregation, entropy_bonus=False)(batch)
    assert ours["clip_fraction"] > 0
    assert_close(ours["loss_actor"], theirs.loss_objective.squeeze())
    pairs = zip(
        gradients(ours["loss_actor"], model),
        gradients(theirs.loss_objective, model),
        strict=True,
    )
    for mine, other in pairs:
        assert_close(mine, other, rtol=1e-4, atol=1e-6)


def test_mc_advantage_divides_by_k_less_1(model):
    """MCAdvantage's deviation is sqrt(K / (K - 1)) of ours, and so the whole loss."""
    actor, batch = make(model, noise=0.3)
    transform = MCAdvantage(grpo_size=3, trajectory_return="sum")
    rows = []
    for row in batch.unbind(0):
        row["next", "done"] = torch.ones(1, 1, dtype=torch.bool)
        rows.append(transform.inv(lazy_stack([row])))
    with_advantage = torch.cat([row for row in rows if row is not None])
    theirs = TorchRLGRPOLoss(actor, aggregation="prompt_mean", entropy_bonus=False)(with_advantage)
    ours = GRPOLoss(actor)(batch)["loss_actor"]
    assert_close(ours, theirs.loss_objective.squeeze() * (3 / 2) ** 0.5)


# -------------------------------------------------------------------------- groups and masks


def test_groups_are_told_by_prompt_or_by_shape(model):
    actor, batch = make(model)
    by_text = ECPOLoss(actor, reduction="none")
    expected = by_text(batch)["loss_actor"]
    by_tokens = ECPOLoss(actor, reduction="none")
    by_tokens.set_keys(prompt=PROMPT)
    in_rows = lazy_stack([batch[i] for i in IN_GROUPS])
    by_number = in_rows.exclude("query").reshape(2, 3)
    for loss_module, data in (
        (by_tokens, batch.exclude("query")),
        (by_text, in_rows.reshape(2, 3)),
        (by_text, by_number),
    ):
        assert_close(loss_module(data)["loss_actor"], expected)


def test_keywords(model):
    actor, batch = make(model, pad_output=True)
    batch = batch.exclude("query")
    batch["query"] = torch.tensor([0, 1, 0, 1, 1, 0])
    loss_module = ECPOLoss(actor)
    keywords = {
        "_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss_module.in_keys
    }
    outputs = loss_module(**keywords)
    assert len(outputs) == len(loss_module.out_keys)
    assert_close(outputs[0], loss_module(batch)["loss_actor"])


def test_a_mask_of_several_turns(model):
    """Tokens between turns are context: what the actor reads, and count for nothing."""
    actor, batch = make(model)
    lengths = [(len(prompt), len(row)) for prompt, row in zip(PROMPTS, RESPONSES, strict=True)]
    own = [[False] * of_prompt + [True] * of_response for of_prompt, of_response in lengths]
    own[3] = [False, False, True, True, False, False, True]
    for row, mask in zip(batch.unbind(0), own, strict=True):
        row["masks", "all_assistant_mask"] = torch.tensor(mask)
    loss_module = RLOOLoss(actor)
    loss_module.loss_mask_key = ("masks", "all_assistant_mask")
    groups = loss_module._read(batch)
    by_hand = tiny.log_probs_by_hand(model, PROMPTS[3], RESPONSES[3])
    assert_close(groups.log_prob[1, 1], by_hand[[0, 1, 4]].sum())
    assert groups.num_steps.tolist() == [[3, 2, 1], [2, 3, 3]]


def test_without_a_mask_all_tokens_count(model):
    """But the first, which follows nothing."""
    actor, batch = make(model)
    batch = record_log_probs(actor, batch)
    loss_module = RLOOLoss(actor)
    loss_module.loss_mask_key = None
    lengths = [[len(PROMPTS[i] + RESPONSES[i]) - 1 for i in members] for members in GROUPS]
    assert loss_module._read(batch).num_steps.tolist() == lengths


def test_a_completion_without_a_token_is_refused(model):
    """Its reward would count for nothing; a mask may leave it out."""
    actor, batch = make(model)
    batch[3][FULL] = batch[3][PROMPT]
    batch[3]["masks", "all_attention_mask"] = torch.ones(len(PROMPTS[3]), dtype=torch.bool)
    batch[3][RECORDED] = torch.zeros(len(PROMPTS[3]))
    loss_module = RLOOLoss(actor)
    with pytest.raises(ValueError, match=r"1 completion\(s\) have no token after the prompt"):
        loss_module(batch)
    loss_module.loss_mask_key = "own"
    for left_out, message in ((3,), None), ((1, 3), "leaves 1 group.* fewer than two trajectories"):
        for i, row in enumerate(batch.unbind(0)):
            after = torch.arange(len(row[FULL])) >= len(PROMPTS[i])
            row["own"] = after & (i not in left_out)
        with pytest.raises(ValueError, match=message) if message else nullcontext():
            means = [sum(REWARDS[i] for i in rows) / len(rows) for rows in ([0, 2, 5], [1, 4])]
            assert loss_module(batch)["return"].item() == pytest.approx(sum(means) / 2)


def test_rewards_of_tokens_are_added_up(model):
    actor, batch = make(model)
    for i, row in enumerate(batch.unbind(0)):
        row["next", "reward"] = torch.full((len(RESPONSES[i]), 1), 0.5)
    returns = RLOOLoss(actor)._read(batch).returns
    assert returns.tolist() == [[len(RESPONSES[i]) / 2 for i in members] for members in GROUPS]


@pytest.mark.parametrize("shape", [(6,), (6, 1), (6, 1, 1)])
def test_rewards_of_completions(model, shape):
    actor, batch = make(model, pad_output=True)
    batch["next", "reward"] = torch.tensor(REWARDS).view(shape)
    assert_close(RLOOLoss(actor)._read(batch).returns, torch.tensor(REWARDS)[torch.tensor(GROUPS)])


def test_rewards_of_padding_count_for_nothing(model):
    """Of all tokens or of the response's; whatever stands there, NaN too."""
    actor, batch = make(model, pad_output=True)
    of_all = (batch[FULL] == END).float()
    rewards = of_all.masked_fill(batch[FULL] == PAD, torch.nan)
    of_response = rewards[:, batch[PROMPT].shape[-1] :]
    for given in (rewards, of_response, of_response.unsqueeze(-1)):
        batch["next", "reward"] = given
        assert (RLOOLoss(actor)._read(batch).returns == 1).all()


def test_rewards_in_half_precision_are_not_added_up_in_it(model):
    actor, batch = make(model)
    expected = torch.tensor([200.0 + i / 2 for i in range(6)])
    for row, total in zip(batch.unbind(0), expected, strict=True):
        row["next", "reward"] = torch.tensor([[100.0], [total - 100]]).bfloat16()
    returns = RLOOLoss(actor)._read(batch).returns
    assert returns.dtype == torch.float32
    assert_close(returns, expected[torch.tensor(GROUPS)])


def test_a_replay_buffer_of_torchrls(model):
    """PromptGroupSampler draws whole groups, rows of other lengths among them."""
    actor, batch = make(model)
    buffer = ReplayBuffer(
        storage=LazyStackStorage(6),
        sampler=PromptGroupSampler(samples_per_group=3, group_key="query"),
        batch_size=3,
    )
    buffer.extend(batch)
    assert abs(ECPOLoss(actor)(buffer.sample())["kl_reference_policy"]) < 1e-4


class Other(nn.Module):
    """A wrapper of another make, which has TorchRL's interface alone."""

    tokens_key, masks_key, log_probs_key, generate = "tokens", "masks", "log_probs", False

    def __init__(self):
        super().__init__()
        self.in_keys = [FULL]
        self.embedding = nn.Embedding(len(tiny.WORDS), len(tiny.WORDS))
        self.tokenizer = tiny.make_tokenizer()

    def get_dist(self, tensordict, *, mask_key, padding_side):
        tokens = tensordict.get(
            FULL, as_padded_tensor=True, padding_side=padding_side, padding_value=PAD
        )
        logits = self.embedding(tokens.roll(1, -1))  # each token given the one before
        return LLMMaskedCategorical(logits=logits, mask=tokens != PAD)


def test_another_wrapper(model):
    actor, batch = Other(), ragged(model)
    record_log_probs(actor, batch)
    groups = RLOOLoss(actor)._read(batch)
    table = actor.embedding.weight.log_softmax(-1)
    assert_close(groups.log_prob[0, 1], table[5, 7] + table[7, END])
    assert_close(groups.log_prob, groups.reference_log_prob)


# --------------------------------------------------------------------------------- the traps


@layouts
def test_what_a_wrapper_samples(model, pad_output):
    """0 is recorded for the first token: refused as it is, mended by computing it anew."""
    sampler = tiny.make_sampler(model, pad_output=pad_output)
    check_sampler(sampler)
    actor, prompts = make(model, pad_output)
    torch.manual_seed(0)
    batch = sampler(prompts.select(PROMPT, "query"))
    batch["next", "reward"] = torch.tensor(REWARDS).view(-1, 1, 1)
    with pytest.raises(KeyError, match="record_log_probs"):
        ECPOLoss(actor)(batch)
    recorded = batch.get(("log_probs", "response"), as_list=True)
    record_log_probs(actor, batch)
    again = batch.get(RECORDED, as_list=True)
    prompts = batch.get(PROMPT, as_list=True)
    for prompt, old, new in zip(prompts, recorded, again, strict=True):
        new = new[len(prompt) : len(prompt) + len(old)]
        real = new != 0  # not padding
        assert old[0] == 0
        assert new[0] < -0.01
        assert_close(old[1:][real[1:]], new[1:][real[1:]], rtol=1e-4, atol=1e-4)
    losses = ECPOLoss(actor)(batch)
    assert abs(losses["kl_reference_policy"]) < 1e-5
    for row, prompt in zip(batch.unbind(0), prompts, strict=True):
        row.get(RECORDED)[len(prompt)] = 0
    with pytest.raises(ValueError, match=r"0 for the first token.*record_log_probs"):
        ECPOLoss(actor)(batch)


def test_half_precision(model):
    actor, batch = make(model, pad_output=True)
    batch[RECORDED] = batch[RECORDED].bfloat16()
    with pytest.raises(ValueError, match=r"bfloat16.*record_log_probs"):
        ECPOLoss(actor)(batch)
    half = tiny.make_actor(tiny.make_model().bfloat16(), pad_output=True)
    losses = ECPOLoss(half)(record_log_probs(half, batch))
    assert losses["loss_actor"].dtype == torch.float32
    assert losses["kl_reference_policy"] == 0


def test_dropout_of_opt():
    """Its rate is a number of the layer's, without a module."""
    sizes = {"hidden_size": 32, "num_hidden_layers": 1, "ffn_dim": 64, "num_attention_heads": 2}
    sizes |= {"vocab_size": len(tiny.WORDS), "word_embed_proj_dim": 32, "pad_token_id": PAD}
    actor = tiny.make_actor(OPTForCausalLM(OPTConfig(**sizes)).train())
    with pytest.raises(ValueError, match=r"drops out 10%.*model.eval"):
        record_log_probs(actor, ragged(tiny.make_model()))


@pytest.mark.parametrize("config", [{"attention_dropout": 0.1}, {}], ids=["rate", "module"])
def test_dropout(model, config):
    dropping = tiny.make_model(**config).train()
    if not config:
        dropping.lm_head = nn.Sequential(nn.Dropout(0.2), dropping.lm_head)
    actor, batch = tiny.make_actor(dropping), ragged(model)
    loss_module = ECPOLoss(actor)
    with pytest.raises(ValueError, match=r"drops out .0%.*model.eval"):
        loss_module(batch)
    loss_module.eval()
    loss_module(batch)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "greedily"),
        ({"do_sample": True, "temperature": 0.7}, "temperature=0.7"),
        ({"do_sample": True, "top_k": 5}, "top_k=5"),
        ({"do_sample": True, "top_p": 0.9}, "top_p=0.9"),
        ({"do_sample": True, "num_beams": 4}, "num_beams=4.*num_beams = 1."),
        (
            {"do_sample": True, "no_repeat_ngram_size": 1},
            "no_repeat_ngram_size=1.*_size = 0.",
        ),
        ({"do_sample": True, "encoder_repetition_penalty": 2.0}, "penalty=2.0.*_penalty = 1."),
        ({"do_sample": True, "bad_words_ids": [[4]]}, "bad_words_ids=.*bad_words_ids = None."),
    ],
)
def test_other_distributions(settings, words):
    model = tiny.make_model()
    sampler = tiny.make_actor(model, generate=True, generate_kwargs=settings)
    with pytest.raises(ValueError, match=words):
        check_sampler(sampler)
    if settings:
        actor = sampler.get_new_version(generate=False, input_key=FULL)
        with pytest.raises(ValueError, match=words):
            ECPOLoss(actor)


@pytest.mark.parametrize("setting", [{"top_h": 0.4}, {"begin_suppress_tokens": [4]}])
def test_other_distributions_of_the_model(setting):
    """What the wrapper does not pass on."""
    model = tiny.make_model()
    sampler = tiny.make_sampler(model)
    model.generation_config.update(**setting)
    with pytest.raises(ValueError, match=f"{next(iter(setting))} = None."):
        check_sampler(sampler)


def test_padding_that_ends_a_completion_is_not_drawn():
    """As of models with several ends, one of which is the padding."""
    model = tiny.make_model()
    sampler = tiny.make_sampler(model)
    model.generation_config.eos_token_id = [1, 0]
    check_sampler(sampler)
    model.generation_config.suppress_tokens = None
    message = r"padding token, 0, is among .*eos_token_id=\[1, 0\].*suppress_tokens = \[0\]"
    with pytest.raises(ValueError, match=message):
        check_sampler(sampler)
    model.generation_config.eos_token_id = 1
    check_sampler(sampler)
    sampler.generate_kwargs["eos_token_id"] = [1, 0]
    with pytest.raises(ValueError, match=message):
        check_sampler(sampler)


@pytest.mark.parametrize("of_model", [True, False])
def test_the_model_pads_with_the_tokenizers_padding(of_model):
    """Else transformers pads with the end of a completion, which counts as a token."""
    model = tiny.make_model(pad_token_id=None if of_model else PAD)
    sampler = tiny.make_sampler(model)
    if not of_model:
        sampler.generate_kwargs["pad_token_id"] = END
    message = "pad_token_id=(None|1) .*the tokenizer with 0.*generation_config.pad_token_id = 0"
    with pytest.raises(ValueError, match=message):
        check_sampler(sampler)
    sampler = tiny.make_sampler(model, tokenizer=tiny.make_tokenizer(pad_token="<end>"))
    with pytest.raises(ValueError, match="no padding token of its own"):
        check_sampler(sampler)


def test_a_model_that_the_wrapper_calls_wrongly():
    """GPT-2's second argument is its cache, which fails inside of transformers."""
    sizes = {"n_embd": 32, "n_layer": 1, "n_head": 2, "vocab_size": len(tiny.WORDS)}
    sizes |= {"bos_token_id": None, "eos_token_id": END, "pad_token_id": PAD}
    model = GPT2LMHeadModel(GPT2Config(**sizes))
    message = "GPT2LMHeadModel.forward takes [a-z_]+ where TorchRL's wrapper passes"
    sampler = tiny.make_sampler(model)
    with pytest.raises(ValueError, match=message):
        check_sampler(sampler)
    with pytest.raises(ValueError, match=message):
        RLOOLoss(tiny.make_actor(model))
    with pytest.raises(TypeError, match=r"Wrap a language model: TransformersWrapper\(model"):
        RLOOLoss(model)


def test_a_compiled_model_is_looked_into():
    sampler = tiny.make_sampler(tiny.make_model())
    sampler.model = torch.compile(sampler.model)
    check_sampler(sampler)


def test_top_k_of_transformers():
    """Without top_k, transformers draws from 50 tokens: harmless where there are no more."""
    settings = {"do_sample": True}
    check_sampler(tiny.make_actor(generate=True, generate_kwargs=settings))
    model = tiny.make_model(vocab_size=51)
    with pytest.raises(ValueError, match="top_k=50"):
        check_sampler(tiny.make_actor(model, generate=True, generate_kwargs=settings))
    model.generation_config.top_k = 0
    check_sampler(tiny.make_actor(model, generate=True, generate_kwargs=settings))


def test_top_k_beside_a_vocabulary_that_a_part_of_the_config_has():
    """As of models of texts and images."""
    model = tiny.make_model()
    sampler = tiny.make_actor(model, generate=True, generate_kwargs={"do_sample": True})
    model.config = SimpleNamespace(get_text_config=lambda: SimpleNamespace(vocab_size=51))
    with pytest.raises(ValueError, match="top_k=50"):
        check_sampler(sampler)


# --------------------------------------------------------------------------------- bad input


def pad_before_the_end(batch):
    batch[FULL][0, 4] = PAD
    batch["masks", "all_attention_mask"][0, 4] = False


def other_prompt(batch):
    batch[PROMPT] = batch[PROMPT].roll(1, -1)


def no_response(batch):
    batch["masks", "all_attention_mask"][:, 3:] = False


BAD = {
    "pad_before_the_end": (pad_before_the_end, ValueError, "padding token before the end"),
    "other_prompt": (other_prompt, ValueError, "does not begin with"),
    "no_response": (no_response, ValueError, "6 completion.* no token after the prompt"),
    "no_log_probs": (lambda b: b.exclude(RECORDED, inplace=True), KeyError, "record_log_probs"),
    "no_prompt": (lambda b: b.exclude(PROMPT, inplace=True), KeyError, "all_assistant_mask"),
    "no_reward": (lambda b: b.exclude(REWARD, inplace=True), KeyError, "'reward'"),
    "no_query": (lambda b: b.exclude("query", inplace=True), KeyError, "prompt="),
    "unequal": (lambda b: b.set("query", torch.tensor([0, 0, 1, 1, 1, 1])), ValueError, "unequal"),
    "of_one": (lambda b: b.set("query", torch.arange(6)), ValueError, "at least 2"),
    "nan_log_prob": (lambda b: b[RECORDED].fill_(torch.nan), ValueError, "NaN or infinite"),
    "short_log_prob": (lambda b: b.set(RECORDED, b[RECORDED][:, 1:]), ValueError, "the shape"),
    "nan_reward": (
        lambda b: b.set(REWARD, torch.full((6, 4, 1), torch.nan)),
        ValueError,
        "NaN or infinite",
    ),
}


@pytest.mark.parametrize(("spoil", "error", "words"), BAD.values(), ids=BAD)
def test_bad_batches(model, spoil, error, words):
    actor, batch = make(model, pad_output=True)
    spoil(batch)
    with pytest.raises(error, match=words) as raised:
        ECPOLoss(actor)(batch)
    assert "\n" not in str(raised.value)


def test_mixed_rows(model):
    actor, batch = make(model)
    with pytest.raises(ValueError, match="hold several prompts"):
        ECPOLoss(actor)(batch.reshape(2, 3))


@pytest.mark.parametrize("lazy", [False, True])
def test_padding_that_the_actor_strips(model, lazy):
    """Its log-probabilities are then of rows without padding, padded anew on the left."""
    batch = dense(ragged(model))
    batch = batch.to_lazystack(0) if lazy else batch
    with pytest.raises(ValueError, match=r"padded, which .* strips.*pad_output=True"):
        ECPOLoss(tiny.make_actor(model))(batch)
    with pytest.raises(ValueError, match=r"padded, which .* strips.*pad_output=True"):
        record_log_probs(tiny.make_actor(model), batch)
    groups = RLOOLoss(tiny.make_actor(model, pad_output=True))._read(batch)
    assert_close(groups.log_prob, groups.behaviour_log_prob, rtol=1e-4, atol=1e-4)


def test_other_tokens(model, monkeypatch):
    """A mask of another shape, as of a wrapper that evaluates others."""
    actor, batch = make(model, pad_output=True)
    loss_module = ECPOLoss(actor)
    loss_module.set_keys(action=("tokens", "other"))
    batch["tokens", "other"] = batch[FULL][:, 1:]
    with pytest.raises(ValueError, match=r"8 tokens, but .* others than were sampled"):
        loss_module(batch)
    divided = actor.get_dist(batch, mask_key=("masks", "all_attention_mask"), padding_side="left")
    monkeypatch.setattr(actor, "get_dist", lambda *_, **__: divided)
    batch[FULL] = batch["tokens", "other"]
    with pytest.raises(ValueError, match=r"8 tokens, but .* others than were sampled"):
        record_log_probs(actor, batch)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"generate": True}, "generate=False"),
        ({"input_key": PROMPT}, "a prompt without its completion"),
        ({"input_mode": "text"}, "input_mode='text'.*input_mode='tokens'"),
        ({"pad_model_input": False}, "packs the rows"),
        ({"tokenizer": tiny.make_tokenizer(pad_token=None)}, "no padding token"),
        ({"tokenizer": tiny.make_tokenizer(pad_token="<end>")}, "no padding token"),
    ],
)
def test_bad_actors(model, options, words):
    with pytest.raises(ValueError, match=words):
        ECPOLoss(tiny.make_actor(model, **options))


def test_losses_that_take_no_completions(model):
    actor = tiny.make_actor(model)
    with pytest.raises(ValueError, match="second copy"):
        ECPOLoss(actor, delay_actor=True)
    with pytest.raises(TypeError, match="values of states"):
        TrustPCLLoss(actor, nn.Identity())
