"""What ``llm.py`` is built from: model and tokenizer, completions, the loss, the evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from itertools import takewhile
from math import comb
from pathlib import Path
from random import Random
from typing import Any

import torch
import transformers
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from tasks import ALPHABET, Countdown, Sums
from tensordict import TensorDict, TensorDictBase
from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers
from torch import Tensor
from torchrl.modules.llm import TransformersWrapper
from torchrl.objectives.llm import GRPOLoss

from torchrl_ecpo import ECPOLoss, PMDLoss, TPOLoss
from torchrl_ecpo.llm import check_sampler, record_log_probs

LOSSES = {"ecpo": ECPOLoss, "pmd": PMDLoss, "tpo": TPOLoss, "grpo": GRPOLoss}
LOCAL = {"local_files_only": True, "trust_remote_code": False}  # nor downloads, nor foreign code
PASSES = (1, 8, 64)


def check_run(config: DictConfig, losses: Collection[str]) -> None:
    """Refuse a loss of the other script, and a directory without a model or without padding."""
    if config.loss.name not in losses:
        raise ValueError(f"loss= is here {' or '.join(losses)}, got {config.loss.name}.")
    if (path := config.model.path) is None:
        if (size := config.model.hidden_size) % 8:
            raise ValueError(
                "model.hidden_size must be a multiple of 8, for four heads of an even size, got "
                f"{size}."
            )
        return
    if not all(map(list, map(Path(path).glob, ("*.safetensors", "tokenizer_config.json")))):
        raise ValueError(
            f"model.path={path}: it must be a directory with a model in *.safetensors and its "
            "tokenizer, as model.save_pretrained and tokenizer.save_pretrained write them."
        )
    tokenizer: Any = transformers.AutoTokenizer.from_pretrained(path, **LOCAL)
    padding, end = tokenizer.pad_token, tokenizer.eos_token
    if end is None or padding in (None, end):
        raise ValueError(
            f"model.path={path}: its tokenizer needs an end and a padding token of its own, got "
            f"pad_token={padding!r} and eos_token={end!r}. Set tokenizer.pad_token to a token that "
            "is never sampled, and save it."
        )


def make_model(config: DictConfig) -> tuple[Any, Any]:
    """A model, which samples from its own distribution, and its tokenizer."""
    if config.path is None:
        model, tokenizer = _small_model(config.hidden_size, config.layers)
    else:
        path: Any = to_absolute_path(config.path)
        tokenizer = transformers.AutoTokenizer.from_pretrained(path, **LOCAL)
        options: Any = {"use_safetensors": True, "dtype": torch.float32, **LOCAL}
        model = transformers.AutoModelForCausalLM.from_pretrained(path, **options)
    ids = {"pad_token_id": tokenizer.pad_token_id, "eos_token_id": tokenizer.eos_token_id}
    model.generation_config = transformers.GenerationConfig(
        do_sample=True, top_k=0, suppress_tokens=[tokenizer.pad_token_id], **ids
    )
    return model.eval(), tokenizer  # no dropout, neither here nor there


def _small_model(hidden_size: int, layers: int) -> tuple[Any, Any]:
    """A Llama, and a tokenizer with a token for each character."""
    words = {word: i for i, word in enumerate(["<pad>", "<end>", "<unk>", *ALPHABET])}
    characters: Any = Tokenizer(models.WordLevel(words, "<unk>"))
    characters.pre_tokenizer = pre_tokenizers.Split(Regex("."), "isolated")
    characters.decoder = decoders.Fuse()
    special: Any = {"pad_token": "<pad>", "eos_token": "<end>", "unk_token": "<unk>"}
    sizes: Any = {"hidden_size": hidden_size, "intermediate_size": 2 * hidden_size}
    sizes |= {"num_hidden_layers": layers, "num_attention_heads": 4, "max_position_embeddings": 64}
    ids: Any = {"pad_token_id": 0, "eos_token_id": 1, "bos_token_id": None}
    config = transformers.LlamaConfig(vocab_size=len(words), **sizes, **ids)
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_object=characters, **special)
    return transformers.LlamaForCausalLM(config), tokenizer


class Policy:
    """A model on a task: TorchRL's two wrappers of it, and its completions."""

    def __init__(self, model: Any, tokenizer: Any, task: Countdown | Sums) -> None:
        self.model, self.tokenizer, self.task = model, tokenizer, task
        options: Any = {"tokenizer": tokenizer, "input_mode": "tokens", "pad_output": True}
        sampling = {"max_new_tokens": task.max_tokens, "do_sample": True}
        self.actor = TransformersWrapper(model, generate=False, **options)
        options |= {"generate_kwargs": sampling, "return_log_probs": False}
        self.sampler = TransformersWrapper(model, generate=True, **options)
        check_sampler(self.sampler)

    def encode(self, texts: list[str], side: str, **options: Any) -> Tensor:
        """Tokens ``[B, L]``."""
        options |= {"padding": True, "padding_side": side, "return_tensors": "pt"}
        return self.tokenizer(texts, **options).input_ids

    def supervise(self, config: DictConfig, random: Random) -> None:
        """The start: gradient steps on the log-probability of right answers."""
        optimizer = torch.optim.Adam(self.model.parameters(), lr=config.lr)
        for _ in range(config.steps):
            pairs = [self.task.draw(random) for _ in range(config.batch_size)]
            prompt = self.encode([prompt for prompt, _ in pairs], "left")
            ended = [answer + self.tokenizer.eos_token for _, answer in pairs]
            answer = self.encode(ended, "right", add_special_tokens=False)
            tokens = torch.cat([prompt, answer], -1)
            mask = tokens != self.tokenizer.pad_token_id
            labels = torch.cat([torch.full_like(prompt, -100), answer], -1).where(mask, -100)
            optimizer.zero_grad()
            self.model(tokens, attention_mask=mask.long(), labels=labels).loss.backward()
            optimizer.step()

    def decode(self, response: Tensor | list[list[int]]) -> list[str]:
        """Tokens as text up to the end, without padding; of an unknown token there is a trace."""
        rows = response.tolist() if isinstance(response, Tensor) else response
        end, padding = self.tokenizer.eos_token_id, self.tokenizer.pad_token_id
        answers = [
            [token for token in takewhile(lambda token: token != end, row) if token != padding]
            for row in rows
        ]
        return ["".join(text.split()) for text in self.tokenizer.batch_decode(answers)]

    def complete(self, prompts: list[str], count: int) -> list[str]:
        """`count` answers to each, by the bare model: the wrapper needs twice the time."""
        tokens = self.encode(prompts, "left").repeat_interleave(count, 0)
        options: Any = {"max_new_tokens": self.task.max_tokens}
        options["attention_mask"] = (tokens != self.tokenizer.pad_token_id).long()
        return self.decode(self.model.generate(tokens, **options)[:, tokens.shape[-1] :])

    def sample_groups(self, prompts: list[str], count: int) -> TensorDictBase:
        """What a loss reads: completions ``[B * count]``, `count` in a row of each prompt.

        TorchRL's own loss is told advantages, as its MCAdvantage has them.
        """
        group = torch.arange(len(prompts)).repeat_interleave(count)
        tokens = {"prompt": self.encode(prompts, "left")[group]}
        batch = self.sampler(TensorDict({"tokens": tokens, "query": group}, [len(group)]))
        answers = self.decode(batch["tokens", "response"])
        right = [self.task.is_right(prompts[i // count], a) for i, a in enumerate(answers)]
        batch["next", "reward"] = torch.tensor(right).float().view(-1, 1, 1)
        batch = record_log_probs(self.actor, batch)
        rewards = batch["next", "reward"].view(-1, count)
        centred = rewards - rewards.mean(-1, keepdim=True)
        advantage = centred / rewards.std(-1, keepdim=True).clamp_min(1e-6)
        return batch.set("advantage", advantage.view(-1, 1, 1))

    def measure(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Of a batch, whatever the loss: entropy in nats, and length in tokens, a completion."""
        response = batch["tokens", "response"]
        log_prob = batch["log_probs", "full"][:, -response.shape[-1] :].sum(-1)
        length = (response != self.tokenizer.pad_token_id).sum(-1)
        of_each = {"return": batch["next", "reward"], "entropy": -log_prob, "length": length}
        return {name: values.float().mean() for name, values in of_each.items()}

    def evaluate(self, config: DictConfig) -> dict[str, float]:
        """pass@k and the number of distinct right answers; writes ``completions.txt``."""
        random, n = Random("evaluation"), config.completions
        prompts = [self.task.draw(random)[0] for _ in range(config.prompts)]
        with torch.random.fork_rng(devices=[]):  # training goes on as if there were none
            torch.manual_seed(0)
            parts = [prompts[i : i + 8] for i in range(0, len(prompts), 8)]
            answers = [answer for part in parts for answer in self.complete(part, n)]
        found = [Counter(answers[i : i + n]) for i in range(0, len(answers), n)]
        right = [
            {answer: times for answer, times in each.items() if self.task.is_right(prompt, answer)}
            for prompt, each in zip(prompts, found, strict=True)
        ]
        Path("completions.txt").write_text("\n".join(map(_listing, prompts[:8], found, right)))
        values = {f"pass_at_{k}": [pass_at(k, n, sum(r.values())) for r in right] for k in PASSES}
        values["distinct_right"] = [len(each) for each in right]
        return {name: sum(each) / len(each) for name, each in values.items()}


def make_loss(config: DictConfig, actor: Any) -> Any:
    """The loss that ``loss=`` names."""
    options: Any = OmegaConf.to_container(config, resolve=True)
    return LOSSES[options.pop("name")](actor, **options)


def pass_at(k: int, n: int, right: int) -> float:
    """The chance that one of k answers is right, if so many of n are."""
    return 1 - comb(n - right, k) / comb(n, k)


def _listing(prompt: str, answers: Counter[str], right: dict[str, int]) -> str:
    """How often each answer came, and whether it is right."""
    rows = answers.most_common(12)
    lines = [f"{times:6} {'right' if a in right else 'wrong'}  {a}\n" for a, times in rows]
    return "".join([f"{prompt}\n", *lines])
