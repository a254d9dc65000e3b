"""What ``llm.py`` is built from: model and tokenizer, samples, the loss, the evaluation."""

from __future__ import annotations

from collections import Counter
from math import comb
from pathlib import Path
from random import Random
from typing import Any

import torch
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from tasks import ALPHABET, Task
from tensordict import TensorDict, TensorDictBase
from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers
from torch import Tensor
from torchrl.modules.llm import TransformersWrapper
from torchrl.objectives.llm import GRPOLoss
from transformers import (
    AutoModelForCausalLM,
    AutoTokenizer,
    GenerationConfig,
    LlamaConfig,
    LlamaForCausalLM,
    PreTrainedTokenizerFast,
)

from torchrl_ecpo import ECPOLoss, PMDLoss, TPOLoss
from torchrl_ecpo.llm import check_sampler, record_log_probs

LOSSES = {"ecpo": ECPOLoss, "pmd": PMDLoss, "tpo": TPOLoss, "grpo": GRPOLoss}
PASSES = (1, 8, 64)
ROWS = 1024  # that are sampled at once
SHOWN = 8  # prompts in completions.txt


def check_model(config: DictConfig) -> None:
    """Refuse a directory without a model that can be read, or with a tokenizer that cannot pad."""
    path = config.model.path
    if path is None:
        return
    if not list(Path(path).glob("*.safetensors")):
        raise ValueError(
            f"model.path={path}: it must be a directory with a model in *.safetensors, and there "
            "is none. Save one with model.save_pretrained and tokenizer.save_pretrained."
        )
    padding, end = (getattr(load_tokenizer(path), f"{name}_token") for name in ("pad", "eos"))
    if end is None or padding in (None, end):
        raise ValueError(
            f"model.path={path}: its tokenizer needs an end and a padding token of its own, got "
            f"pad_token={padding!r} and eos_token={end!r}. Set tokenizer.pad_token to a token that "
            "is never sampled, and save it."
        )


def load_tokenizer(path: str) -> Any:
    """The one in a directory; nothing is downloaded, nor code run that lies there."""
    return AutoTokenizer.from_pretrained(path, local_files_only=True, trust_remote_code=False)


def make_tokenizer() -> Any:
    """A token for each character."""
    words = {word: i for i, word in enumerate(["<pad>", "<end>", "<unk>", *ALPHABET])}
    tokenizer = Tokenizer(models.WordLevel(words, "<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("."), "isolated")  # pyright: ignore[reportAttributeAccessIssue]
    tokenizer.decoder = decoders.Fuse()  # pyright: ignore[reportAttributeAccessIssue]
    special = {"pad_token": "<pad>", "eos_token": "<end>", "unk_token": "<unk>"}
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, **special)


def make_model(config: DictConfig) -> tuple[Any, Any]:
    """A model, which samples from its own distribution, and its tokenizer."""
    if config.path is None:
        tokenizer = make_tokenizer()
        model: Any = LlamaForCausalLM(
            LlamaConfig(
                vocab_size=len(tokenizer),
                hidden_size=config.hidden_size,
                intermediate_size=2 * config.hidden_size,
                num_hidden_layers=config.layers,
                num_attention_heads=4,
                max_position_embeddings=64,
                pad_token_id=tokenizer.pad_token_id,
                bos_token_id=None,
                eos_token_id=tokenizer.eos_token_id,
            )
        )
    else:
        path = to_absolute_path(config.path)
        tokenizer = load_tokenizer(path)
        options = {"use_safetensors": True, "local_files_only": True, "trust_remote_code": False}
        model = AutoModelForCausalLM.from_pretrained(path, dtype=torch.float32, **options)
    model.generation_config = GenerationConfig(
        do_sample=True,
        top_k=0,
        suppress_tokens=[tokenizer.pad_token_id],
        pad_token_id=tokenizer.pad_token_id,
        eos_token_id=tokenizer.eos_token_id,
    )
    return model.eval(), tokenizer  # no dropout, neither here nor there


class Policy:
    """A model on a task: TorchRL's two wrappers of it, and its answers as text."""

    def __init__(self, model: Any, tokenizer: Any, task: Task) -> None:
        self.model, self.tokenizer, self.task = model, tokenizer, task
        options = {"tokenizer": tokenizer, "input_mode": "tokens", "pad_output": True}
        self.sampler = TransformersWrapper(
            model,
            generate=True,
            generate_kwargs={"max_new_tokens": task.max_tokens, "do_sample": True},
            return_log_probs=False,
            **options,
        )
        check_sampler(self.sampler)
        self.actor = TransformersWrapper(model, generate=False, **options)

    def encode(self, texts: list[str], side: str = "left") -> Tensor:
        """Tokens ``[B, L]``."""
        return self.tokenizer(
            texts, padding=True, padding_side=side, return_tensors="pt"
        ).input_ids

    def sample(self, prompts: list[str], count: int) -> tuple[TensorDictBase, list[str]]:
        """Completions ``[B * count]``, `count` running of each prompt, rewarded; and as text."""
        group = torch.arange(len(prompts)).repeat_interleave(count)
        tokens = {"prompt": self.encode(prompts)[group]}
        batch = self.sampler(TensorDict({"tokens": tokens, "query": group}, [len(group)]))
        response = batch["tokens", "response"]
        texts = self.tokenizer.batch_decode(response, skip_special_tokens=True)
        answers = ["".join(text.split()) for text in texts]
        right = [self.task.is_right(prompts[i // count], a) for i, a in enumerate(answers)]
        batch["next", "reward"] = torch.tensor(right).float().view(-1, 1, 1)
        return batch, answers

    def sample_groups(self, prompts: list[str], count: int) -> TensorDictBase:
        """What a loss reads, TorchRL's own included, which is told advantages."""
        batch = record_log_probs(self.actor, self.sample(prompts, count)[0])
        rewards = batch["next", "reward"].view(-1, count)  # as MCAdvantage does it
        spread = rewards.std(-1, keepdim=True).clamp_min(1e-6)
        advantage = (rewards - rewards.mean(-1, keepdim=True)) / spread
        return batch.set("advantage", advantage.view(-1, 1, 1))

    def measure(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Of a batch, whatever the loss: entropy in nats, and length in tokens, a completion."""
        response = batch["tokens", "response"]
        log_prob = batch["log_probs", "full"][:, -response.shape[-1] :].sum(-1)
        length = (response != self.tokenizer.pad_token_id).sum(-1)
        means = {"return": batch["next", "reward"], "entropy": -log_prob, "length": length}
        return {name: values.float().mean() for name, values in means.items()}

    def evaluate(self, config: DictConfig, path: Path) -> dict[str, float]:
        """pass@k and the number of distinct right answers; writes some answers to a file."""
        random, n = Random("evaluation"), config.completions
        prompts = [self.task.draw(random)[0] for _ in range(config.prompts)]
        at_once = max(ROWS // n, 1)
        found: list[Counter[str]] = []
        for i in range(0, len(prompts), at_once):
            answers = self.sample(prompts[i : i + at_once], n)[1]
            found += [Counter(answers[j : j + n]) for j in range(0, len(answers), n)]
        right = [
            {answer: times for answer, times in answers.items() if self.task.is_right(p, answer)}
            for p, answers in zip(prompts, found, strict=True)
        ]
        path.write_text("".join(map(_listing, prompts[:SHOWN], found, right)))
        passes = {f"pass_at_{k}": [_passes(n, sum(r.values()), k) for r in right] for k in PASSES}
        metrics = {**passes, "distinct_right": [len(answers) for answers in right]}
        return {name: sum(values) / len(values) for name, values in metrics.items()}

    def supervise(self, config: DictConfig, random: Random) -> None:
        """The start: gradient steps on the log-probability of right answers."""
        optimizer = torch.optim.Adam(self.model.parameters(), lr=config.lr)
        for _ in range(config.steps):
            prompts, answers = zip(*(self.task.draw(random) for _ in range(config.batch_size)))
            prompt = self.encode([*prompts])
            ended = [answer + self.tokenizer.eos_token for answer in answers]
            answer = self.tokenizer(
                ended, padding=True, padding_side="right", return_tensors="pt", add_special_tokens=False
            ).input_ids
            tokens, padding = torch.cat([prompt, answer], -1), self.tokenizer.pad_token_id
            labels = torch.cat([torch.full_like(prompt, -100), answer], -1)
            labels = labels.where((tokens != padding), -100)
            loss = self.model(tokens, attention_mask=(tokens != padding).long(), labels=labels).loss
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def make_loss(config: DictConfig, actor: Any) -> Any:
    """The loss that ``loss=`` names."""
    options: Any = OmegaConf.to_container(config, resolve=True)
    return LOSSES[options.pop("name")](actor, **options)


def total_loss(losses: Any) -> Tensor:
    """All that is differentiated: TorchRL's loss may have a part for the entropy."""
    return torch.stack([v.sum() for k, v in losses.items() if k.startswith("loss_")]).sum()


def _passes(n: int, right: int, k: int) -> float:
    """The chance that one of k answers is right, of n drawn."""
    return 1 - comb(n - right, k) / comb(n, k)


def _listing(prompt: str, answers: Counter[str], right: dict[str, int]) -> str:
    lines = [
        f"{times:6} {'right' if answer in right else 'wrong'}  {answer}"
        for answer, times in answers.most_common(12)
    ]
    return "\n".join([prompt, *lines, "", ""])
