"""A language model of two layers made from its config, a tokenizer in memory, and batches."""

from __future__ import annotations

import torch
from tensordict import TensorDict, lazy_stack
from tokenizers import Tokenizer, models, pre_tokenizers
from torchrl.modules.llm import TransformersWrapper
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

WORDS = ["<pad>", "<end>", "<unk>", *"abcdefgh"]
PAD, END, UNKNOWN = range(3)
PROMPTS = [[3, 4, 5], [6, 7], [3, 4, 5], [6, 7], [6, 7], [3, 4, 5]]  # two groups of three
RESPONSES = [[8, 9, END], [10, END], [7, END], [9, 9, 9, 8, END], [3, 4, END], [END]]
REWARDS = [0.0, 1.0, 2.0, 0.5, 3.0, 1.0]


def make_tokenizer(**special):
    tokenizer = Tokenizer(models.WordLevel({w: i for i, w in enumerate(WORDS)}, "<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"pad_token": "<pad>", "eos_token": "<end>", "unk_token": "<unk>"} | special
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, **special)


def make_model(seed=0, **config):
    torch.manual_seed(seed)
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2}
    heads = {"num_attention_heads": 2, "num_key_value_heads": 2, "max_position_embeddings": 64}
    ids = {"pad_token_id": PAD, "eos_token_id": END, "bos_token_id": None}
    config = sizes | heads | ids | {"vocab_size": len(WORDS), "initializer_range": 0.3} | config
    return LlamaForCausalLM(LlamaConfig(**config)).eval()


def make_actor(model=None, **options):
    options = {"tokenizer": make_tokenizer(), "input_mode": "tokens", "generate": False} | options
    return TransformersWrapper(make_model() if model is None else model, **options)


def make_sampler(model, **options):
    model.generation_config.top_k = 0
    model.generation_config.suppress_tokens = [PAD]
    settings = {"max_new_tokens": 6, "do_sample": True}
    return make_actor(model, generate=True, generate_kwargs=settings, **options)


def log_probs_by_hand(model, prompt, response):
    """Log-probability of each token of the response, from one row without padding."""
    tokens = torch.tensor([*prompt, *response])
    log_probs = model(tokens.unsqueeze(0)).logits[0].log_softmax(-1)
    return log_probs[:-1].gather(-1, tokens[1:, None]).squeeze(-1)[len(prompt) - 1 :]


def ragged(model, noise=0.0, prompts=PROMPTS, responses=RESPONSES, rewards=REWARDS):
    """Completions [B], each of its own length, as a wrapper with pad_output=False gives them."""
    generator, rows = torch.Generator().manual_seed(0), []
    for prompt, response, reward in zip(prompts, responses, rewards, strict=True):
        with torch.no_grad():
            log_probs = log_probs_by_hand(model, prompt, response)
        log_probs += noise * torch.randn(len(response), generator=generator)
        nothing = torch.full((len(prompt),), torch.nan)  # as vLLMWrapper has it
        row = {
            "tokens": {"prompt": torch.tensor(prompt), "full": torch.tensor(prompt + response)},
            "log_probs": {"full": torch.cat([nothing, log_probs])},
            "query": " ".join(WORDS[token] for token in prompt),
            "next": {"reward": torch.full((1, 1), reward)},
        }
        rows.append(TensorDict(row))
    return lazy_stack(rows)


def dense(batch):
    """The same, as with pad_output=True: prompts padded on the left, responses on the right."""
    rows = [batch.get(key, as_list=True) for key in (("tokens", "prompt"), ("tokens", "full"))]
    recorded = batch.get(("log_probs", "full"), as_list=True)
    of_prompt = max(len(prompt) for prompt in rows[0])
    length = of_prompt + max(len(f) - len(p) for p, f in zip(*rows, strict=True))
    tokens = torch.full((len(batch), length), PAD)
    log_probs = torch.full(tokens.shape, torch.nan)
    for i, (prompt, full) in enumerate(zip(*rows, strict=True)):
        place = slice(of_prompt - len(prompt), of_prompt - len(prompt) + len(full))
        tokens[i, place], log_probs[i, place] = full, recorded[i]
    return TensorDict(
        {
            "tokens": {"prompt": tokens[:, :of_prompt], "full": tokens},
            "masks": {"all_attention_mask": tokens != PAD},
            "log_probs": {"full": log_probs},
            "query": batch["query"],
            "next": {"reward": batch["next", "reward"]},
        },
        [len(batch)],
    )
