"""Completions of a language model, as TorchRL's wrappers write them, read as trajectories.

Shapes: `B` completions in rows, or groups `[*G, K]` of them; `L` tokens of the longest prompt and
completion together. Shorter ones are padded on the left, as the wrappers do.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import cross_entropy

from torchrl_ecpo.checks import (
    check_group_size,
    check_mask,
    check_real,
    present,
    values_can_be_seen,
)
from torchrl_ecpo.functional import widened

# What leaves the policy's own distribution as it is, by name of the sampler's setting.
NEUTRAL: Mapping[str, tuple[float | None, ...]] = {
    "temperature": (None, 1),
    "top_k": (None, 0, -1),
    "top_p": (None, 1),
    "min_p": (None, 0),
    "repetition_penalty": (None, 1),
    "encoder_repetition_penalty": (None, 1),
    "presence_penalty": (None, 0),
    "frequency_penalty": (None, 0),
    "typical_p": (None, 1),
    "top_h": (None,),
    "epsilon_cutoff": (None, 0),
    "eta_cutoff": (None, 0),
    "num_beams": (None, 1),
    "no_repeat_ngram_size": (None, 0),
    "encoder_no_repeat_ngram_size": (None, 0),
    "guidance_scale": (None, 1),
    "min_length": (None, 0),
    "min_new_tokens": (None, 0),
    "bad_words_ids": (None,),
    "begin_suppress_tokens": (None,),
    "force_words_ids": (None,),
    "forced_eos_token_id": (None,),
    "sequence_bias": (None,),
    "exponential_decay_length_penalty": (None,),
    "watermarking_config": (None,),
}


def is_language_model(actor: Any) -> bool:
    """Whether an actor has the interface of TorchRL's ``LLMWrapperBase``."""
    return all(hasattr(actor, name) for name in ("tokens_key", "masks_key", "log_probs_key"))


def check_actor(actor: Any) -> None:
    """Refuse a wrapper whose log-probabilities cannot be those of the completions."""
    if actor.generate:
        raise ValueError(
            "The actor generates (generate=True), so it has no get_dist. Build a second wrapper of "
            "the same model, with generate=False."
        )
    if "prompt" in actor.in_keys[0]:
        raise ValueError(
            f"The actor reads {actor.in_keys[0]!r}, a prompt without its completion. Leave out "
            "input_key, or name the 'full' entry (get_new_version(generate=False) keeps the "
            "sampler's key)."
        )
    _own_padding(actor)
    mode = getattr(actor, "input_mode", "tokens")
    if mode != "tokens":
        raise ValueError(
            f"The actor has input_mode={mode!r}: it would divide texts into tokens anew, which may "
            "be others than were sampled. Build it with input_mode='tokens'; the sampler writes "
            "them, whatever it reads."
        )
    if not getattr(actor, "pad_model_input", True):
        raise ValueError(
            "The actor packs the rows into one (pad_model_input=False), where TorchRL's mask lets "
            "tokens see those after them. Leave out pad_model_input."
        )
    if hasattr(getattr(actor, "model", None), "generation_config"):
        _check_arguments(actor.model)
    _check_settings(_settings(actor))


def check_sampler(sampler: Any) -> None:
    """Refuse a generating wrapper that does not sample from its model's own distribution.

    ``TransformersWrapper`` records log-probabilities of the unchanged model, whatever it samples
    from: nothing in a batch tells that they are not the sampler's.

    Args:
        sampler: a ``TransformersWrapper`` or ``vLLMWrapper`` with ``generate=True``.

    Raises:
        ValueError: for greedy decoding (the default of transformers), a temperature other than 1,
            top-k (by default, transformers draws from the 50 likeliest tokens), top-p, min-p,
            beams, penalties and what else changes probabilities, be it the wrapper's or of the
            model's ``generation_config``; where the model pads with another token than the
            tokenizer, or with one that ends a completion; and for a model that the wrapper calls
            wrongly, such as GPT-2.

    Examples:
        >>> from types import SimpleNamespace
        >>> sampler = SimpleNamespace(generate_kwargs={"temperature": 0.7})  # as of a wrapper
        >>> check_sampler(sampler)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: The sampler has temperature=0.7, so that it draws from another distribution ...
    """
    config = getattr(getattr(sampler, "model", None), "generation_config", None)
    settings = _settings(sampler)
    if config is not None:
        of_model = {name: getattr(config, name, None) for name in ("do_sample", *NEUTRAL)}
        settings = of_model | {name: x for name, x in settings.items() if x is not None}
        if settings["top_k"] is None:
            settings["top_k"] = 50
        if not settings["do_sample"]:
            raise ValueError(
                "The sampler decodes greedily: all completions of a prompt would be the same. Add "
                "do_sample=True to its generate_kwargs."
            )
        if settings["top_k"] >= sampler.model.config.get_text_config().vocab_size:
            settings["top_k"] = 0
        _check_padding(sampler, config)
        _check_arguments(sampler.model)
    _check_settings(settings)


def _check_arguments(model: Any) -> None:
    """Refuse a model whose attention mask TorchRL's wrapper would pass for something else."""
    model = getattr(model, "_orig_mod", model)  # which torch.compile wraps
    second = [*inspect.signature(model.forward).parameters.values()][1:2]
    named = [one.name for one in second if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
    if named not in ([], ["attention_mask"]):
        raise ValueError(
            f"{type(model).__name__}.forward takes {named[0]} where TorchRL's wrapper passes the "
            "attention mask, second. Take a model that has its mask there, as Llama, Qwen, OPT and "
            "GPT-NeoX have it, or call it in an actor of your own, as for samples of your own "
            "(documentation, tutorials/own_samples)."
        )


def _own_padding(wrapper: Any) -> int:
    """The padding token, which must be none that ends a completion."""
    tokenizer = getattr(wrapper, "tokenizer", None)
    padding = getattr(tokenizer, "pad_token_id", None)
    if padding is None or padding == getattr(tokenizer, "eos_token_id", None):
        raise ValueError(
            "The tokenizer has no padding token of its own (the wrapper then takes the "
            "end-of-sequence token, and the end of a completion would count for nothing). Set "
            "tokenizer.pad_token to a token that is never sampled."
        )
    return padding


def _check_padding(sampler: Any, config: Any) -> None:
    """Refuse padding that would count as a token, and tokens that would count as padding."""
    padding = _own_padding(sampler)
    options = sampler.generate_kwargs or {}
    given = {
        name: options.get(name, getattr(config, name, None))
        for name in ("pad_token_id", "eos_token_id", "suppress_tokens")
    }
    if given["pad_token_id"] != padding:
        raise ValueError(
            f"The model pads with pad_token_id={given['pad_token_id']} (None: the end of a "
            f"completion), the tokenizer with {padding}: padding would count as sampled. Leave it "
            f"out of generate_kwargs, and set model.generation_config.pad_token_id = {padding}."
        )
    ends = given["eos_token_id"]
    ends = ends if isinstance(ends, (list, tuple)) else [ends]
    if padding in ends and padding not in (given["suppress_tokens"] or ()):
        raise ValueError(
            f"The padding token, {padding}, is among eos_token_id={ends}: an end of a completion "
            "would count for nothing. Leave it out of generate_kwargs, or set "
            f"model.generation_config.suppress_tokens = [{padding}]."
        )


def _settings(wrapper: Any) -> dict[str, Any]:
    """How a wrapper was told to sample, with vLLM's own defaults."""
    given = getattr(wrapper, "generate_kwargs", None) or {}
    parameters = getattr(wrapper, "sampling_params", None)
    names = ("do_sample", *NEUTRAL)
    return {name: given.get(name, getattr(parameters, name, None)) for name in names}


def _check_settings(settings: Mapping[str, Any]) -> None:
    """Refuse settings under which a model is not sampled from its own distribution."""
    for name, neutral in NEUTRAL.items():
        if settings[name] not in neutral:
            raise ValueError(
                f"The sampler has {name}={settings[name]}, so that it draws from another "
                "distribution than the model's own, which the loss takes the policy to be. Leave "
                "it out of the sampler's options; with transformers, also set "
                f"model.generation_config.{name} = {neutral[1] if len(neutral) > 1 else None}."
            )


@torch.no_grad()
def record_log_probs(actor: Any, tensordict: TensorDictBase) -> TensorDictBase:
    """Write the log-probability of every token under an actor, in single precision.

    For samplers that do not record them, or not exactly: ``TransformersWrapper`` writes those of
    the response only, 0 for its first token, in the model's own precision. Call it with the weights
    that sampled, before the first update.

    Args:
        actor: a wrapper with ``generate=False``.
        tensordict: completions ``[B]`` or ``[*G, K]`` with ``("tokens", "full")``.

    Returns:
        The same tensordict, with ``("log_probs", "full")``, ``[L]`` in each row; 0 for the first
        token, which has no probability, and for padding.

    Raises:
        ValueError: if dropout is on, or a padding token stands between others.

    Examples:
        A wrapper by its interface alone, of which each of 3 tokens has probability 1/3:

        >>> from types import SimpleNamespace
        >>> from tensordict import TensorDict
        >>> from torchrl.modules.distributions import LLMMaskedCategorical
        >>> mask = torch.ones(2, 3, dtype=torch.bool)
        >>> actor = torch.nn.Module()
        >>> actor.tokens_key, actor.masks_key, actor.log_probs_key = "tokens", "masks", "log_probs"
        >>> actor.generate, actor.in_keys = False, [("tokens", "full")]
        >>> actor.tokenizer = SimpleNamespace(pad_token_id=0, eos_token_id=1)
        >>> actor.get_dist = lambda *_, **__: LLMMaskedCategorical(torch.zeros(2, 3, 3), mask)
        >>> tokens = torch.tensor([[2, 2, 1], [2, 1, 2]])
        >>> batch = TensorDict({"tokens": {"full": tokens}}, [2])
        >>> record_log_probs(actor, batch)["log_probs", "full"][0]
        tensor([ 0.0000, -1.0986, -1.0986])
    """
    check_actor(actor)
    _check_dropout(actor)
    rows = tensordict.reshape(-1)
    logits, attention, tokens = _evaluate(actor, rows, (actor.tokens_key, "full"))
    log_prob = _log_prob(logits, tokens, _with_context(attention, attention))
    key = (actor.log_probs_key, "full")
    lengths = [len(row) for row in _entries(rows, (actor.tokens_key, "full"))]
    if min(lengths) == max(lengths):
        return tensordict.set(key, log_prob.reshape(*tensordict.shape, -1))
    for row, length, values in zip(rows.unbind(0), lengths, log_prob, strict=True):
        row.set(key, values[len(values) - length :])
    return tensordict


def read_completions(
    actor: Any,
    tensordict: TensorDictBase,
    *,
    tokens_key: NestedKey,
    log_prob_key: NestedKey,
    reward_key: NestedKey,
    prompt_key: NestedKey,
    mask_key: NestedKey | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Read completions as groups.

    Args:
        actor: a wrapper with ``generate=False``.
        tensordict: completions ``[B]``, groups of which `prompt_key` tells, or groups ``[*G, K]``.
        tokens_key: prompt and completion.
        log_prob_key: their recorded log-probabilities.
        reward_key: of a completion, ``[B]`` or ``[B, 1]``, or of its tokens (all, or those of the
            response), which are added up; those of padding count for nothing.
        prompt_key: text, integer or tokens, equal within a group only.
        mask_key: which tokens are the policy's own. ``"auto"``: those after the prompt; None: all.

    Returns:
        Of each token ``[*G, K, L]``: rewards, the return of a completion being at its last token;
        log pi_theta, which carries the gradient; the recorded log-probability; and the mask of the
        policy's own tokens, outside of which numbers are 0.
    """
    _check_dropout(actor)
    rows, members = tensordict.reshape(-1), _members(tensordict, prompt_key)
    logits, attention, tokens = _evaluate(actor, rows, tokens_key)
    returns = _returns(rows, reward_key, (actor.tokens_key, "prompt"), attention)
    if mask_key == "auto":
        mask = attention & _after_prompt(rows, tokens, tokens_key, (actor.tokens_key, "prompt"))
        if values_can_be_seen() and not mask.any(-1).all():
            raise ValueError(
                f"{int((~mask.any(-1)).sum())} completion(s) have no token after the prompt, and "
                "their rewards would count for nothing. Keep the token that ends a completion, or "
                "leave such rows out by a mask, loss_module.loss_mask_key."
            )
    elif mask_key is None:
        mask = attention
    else:
        mask = attention & check_mask(mask_key, _padded(rows, mask_key, False), attention.shape)
    mask = _with_context(mask, attention)
    log_prob = _log_prob(logits, tokens, mask)
    if _entries(rows, log_prob_key) is None:
        raise KeyError(
            f"The entry {log_prob_key!r} is missing: the log-probability of each token under the "
            "policy that drew it. Compute it with torchrl_ecpo.llm.record_log_probs(actor, batch), "
            "before the first update."
        )
    recorded = _recorded(_padded(rows, log_prob_key, 0.0), log_prob_key, log_prob, mask)
    last = mask & (mask.flip(-1).cumsum(-1).flip(-1) == 1)
    rewards = returns.to(log_prob.dtype).unsqueeze(-1).where(last, 0.0)
    return rewards[members], log_prob[members], recorded[members], mask[members]


# ------------------------------------------------------------------------------------- small parts


def _members(tensordict: TensorDictBase, prompt_key: NestedKey) -> Tensor:
    """The rows of each group ``[*G, K]``, as numbers among all rows."""
    prompts = _entries(tensordict.reshape(-1), prompt_key)
    if prompts is not None:
        prompts = prompts.tolist() if hasattr(prompts, "tolist") else prompts
        prompts = [_hashable(prompt) for prompt in prompts]
    if tensordict.ndim > 1:
        members = torch.arange(tensordict.numel()).view(tensordict.shape)
    elif prompts is None:
        raise KeyError(
            f"The entry {prompt_key!r} is missing, which tells the groups of a batch "
            f"{list(tensordict.shape)} apart; there are {present(tensordict)}. Name another with "
            "set_keys(prompt=...), such as ('tokens', 'prompt'), or give the K completions of each "
            "group in a row: batch.reshape(-1, K)."
        )
    else:
        rows: dict[Any, list[int]] = {}
        for number, prompt in enumerate(prompts):
            rows.setdefault(prompt, []).append(number)
        sizes = sorted({len(group) for group in rows.values()})
        if len(sizes) > 1:
            raise ValueError(
                f"Groups of unequal size: {prompt_key!r} tells of {len(rows)} groups, of {sizes} "
                "completions. Draw whole ones, such as with TorchRL's PromptGroupSampler."
            )
        members = torch.tensor(list(rows.values()))
    check_group_size(members.shape[-1], f"K of the batch {list(tensordict.shape)}")
    groups = members.flatten(0, -2).tolist()
    mixed = prompts is not None and sum(len({prompts[i] for i in group}) > 1 for group in groups)
    if mixed:
        raise ValueError(f"{mixed} groups [*G, K] hold several prompts ({prompt_key!r}).")
    return members


def _hashable(entry: Any) -> Any:
    """A text, number or row of tokens, so that equal ones are found."""
    entry = entry.tolist() if isinstance(entry, Tensor) else entry
    return tuple(entry) if isinstance(entry, list) else entry


def _padded(rows: Any, key: NestedKey, fill: float) -> Tensor:
    """An entry ``[B, L, ...]``; rows of unequal length are padded on the left."""
    value = rows.get(key, None, as_padded_tensor=True, padding_side="left", padding_value=fill)
    if value is None:
        raise KeyError(f"The entry {key!r} is missing; there are {present(rows)}.")
    return value


def _entries(rows: Any, key: NestedKey) -> Any:
    """An entry row by row, each with the padding that it has itself; None if it is missing."""
    return rows.get(key, None, as_list=True)


def _returns(rows: Any, key: NestedKey, prompt_key: NestedKey, attention: Tensor) -> Tensor:
    """The returns ``[B]``, in single precision at least: equal ones must not come of rounding."""
    rewards = _padded(rows, key, 0.0)
    of_steps = rewards.shape[1:2] or (1,)
    rewards = widened(rewards).reshape(len(rewards), *of_steps, -1).sum(-1)
    width, length = rewards.shape[-1], attention.shape[-1]
    prompts = _entries(rows, prompt_key)
    of_response = length - max(len(prompt) for prompt in prompts) if prompts is not None else length
    if width in (length, of_response):
        rewards = rewards.where(attention[:, length - width :], 0.0)
    check_real(key, rewards)
    return rewards.sum(-1)


def _evaluate(actor: Any, rows: TensorDictBase, key: NestedKey) -> tuple[Tensor, Tensor, Tensor]:
    """Logits ``[B, L, V]`` of each token given those before it, which are real, and the tokens."""
    tokens = _padded(rows, key, -1)
    strips = not getattr(actor, "pad_output", True) and values_can_be_seen()
    if strips and (tokens == actor.tokenizer.pad_token_id).any():
        raise ValueError(
            f"Rows of {key!r} are padded, which the actor strips (pad_output=False), so that its "
            "log-probabilities would be of other tokens. Build it with pad_output=True."
        )
    logits, attention = _logits(actor, rows)
    if tokens.shape != attention.shape:
        raise ValueError(
            f"The actor evaluates {attention.shape[-1]} tokens, but {key!r} has "
            f"{tokens.shape[-1]}: others than were sampled."
        )
    return logits, attention, tokens


def _logits(actor: Any, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Logits ``[B, L, V]`` of each token given those before it, and which tokens are real."""
    attention_key = (actor.masks_key, "all_attention_mask")
    distribution = actor.get_dist(rows, mask_key=attention_key, padding_side="left")
    attention = distribution.mask.bool()
    if values_can_be_seen():
        begins = (attention[:, 1:] & ~attention[:, :-1]).sum(-1) + attention[:, 0]
        if (begins > 1).any():
            raise ValueError(
                f"{int((begins > 1).sum())} completions have padding between their tokens "
                f"({attention_key!r}). If prompts were padded on the right, set the tokenizer's "
                "padding_side='left'. Else the sampler drew a padding token before the end: drop "
                "them, or keep the sampler from it, with suppress_tokens for example."
            )
    return distribution.logits, attention


def _after_prompt(
    rows: TensorDictBase, tokens: Tensor, tokens_key: NestedKey, prompt_key: NestedKey
) -> Tensor:
    """Which tokens ``[B, L]`` come after the prompt."""
    if _entries(rows, prompt_key) is None:
        raise KeyError(
            f"The entry {prompt_key!r} is missing, after which a completion begins; there are "
            f"{present(rows)}. Or name a mask of the policy's own tokens: "
            "loss_module.loss_mask_key = ('masks', 'all_assistant_mask')."
        )
    prompt, length = _padded(rows, prompt_key, 0), tokens.shape[-1]
    of_prompt, of_all = (
        torch.tensor([len(row) for row in _entries(rows, key)], device=tokens.device).unsqueeze(-1)
        for key in (prompt_key, tokens_key)
    )
    begin = length - of_all + of_prompt
    if values_can_be_seen():
        distance = torch.arange(prompt.shape[-1], 0, -1, device=tokens.device)
        beside = tokens.gather(-1, (begin - distance).clamp(0, length - 1))
        differs = ((beside != prompt) & (distance <= of_prompt)).any(-1)
        if differs.any():
            raise ValueError(
                f"In {int(differs.sum())} rows {tokens_key!r} does not begin with {prompt_key!r}, "
                "padding included: where does the completion begin? Name a mask of the policy's "
                "own tokens with loss_module.loss_mask_key."
            )
    return torch.arange(length, device=tokens.device) >= begin


def _with_context(mask: Tensor, attention: Tensor) -> Tensor:
    """Without the first real token of a row: nothing stands before it that it could follow."""
    return torch.cat([torch.zeros_like(mask[:, :1]), mask[:, 1:] & attention[:, :-1]], -1)


def _log_prob(logits: Tensor, tokens: Tensor, mask: Tensor) -> Tensor:
    """Log-probabilities ``[B, L]``, 0 elsewhere, of the tokens where the mask is True.

    In single precision at least. Only their logits are taken: prompts and padding cost nothing.
    """
    log_prob = -cross_entropy(widened(logits[mask]), tokens[mask], reduction="none")
    return log_prob.new_zeros(mask.shape).masked_scatter(mask, log_prob)


def _recorded(recorded: Tensor, key: NestedKey, log_prob: Tensor, mask: Tensor) -> Tensor:
    """Recorded log-probabilities ``[B, L]``, 0 where the mask is False."""
    check_real(key, recorded)
    anew = "Compute them anew with torchrl_ecpo.llm.record_log_probs(actor, batch), before the "
    anew += "first update."
    if recorded.shape != mask.shape:
        raise ValueError(
            f"The log-probabilities {key!r} must have the shape {tuple(mask.shape)} of the tokens, "
            f"got {tuple(recorded.shape)}. Of the completions alone, pad them on the left: "
            f"torch.nn.functional.pad(log_probs, (prompt_length, 0)). {anew}"
        )
    if torch.finfo(recorded.dtype).bits < 32:
        raise ValueError(
            f"The log-probabilities {key!r} are of {recorded.dtype}: summed over a completion, "
            f"they are off by nats. {anew}"
        )
    recorded = recorded.detach().where(mask, 0.0).to(log_prob.dtype)
    first = mask & (mask.cumsum(-1) == 1)
    if values_can_be_seen() and (first & (recorded == 0) & (log_prob < -0.1)).any():
        raise ValueError(
            f"The log-probabilities {key!r} are 0 for the first token of completions, where the "
            f"actor's are not: TransformersWrapper records no other. {anew}"
        )
    return recorded


def _check_dropout(actor: Any) -> None:
    """Refuse dropout: the policy that sampled had other units than the one that is evaluated."""
    for name, module in actor.named_modules():
        # Some keep their rate as a number, without a module: OPT for example.
        is_dropout = "Dropout" in type(module).__name__
        numbers = {key: x for key, x in vars(module).items() if isinstance(x, float)}
        rates = [x for key, x in numbers.items() if "drop" in key or (is_dropout and key == "p")]
        rate = max(rates, default=0.0)
        if module.training and rate > 0:
            raise ValueError(
                f"The actor's {name!r} drops out {rate:.0%} of its units, so that its "
                "log-probabilities are not those of the policy that sampled. Call model.eval(), "
                "or build the model without dropout, where a trainer calls train() itself."
            )
