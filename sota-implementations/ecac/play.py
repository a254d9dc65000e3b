"""Show how the policy of a run plays: ``python play.py runs/halfcheetah/ecac/seed_1/<time>``.

It prints the returns of greedy episodes, and draws the first one where the task can be drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointError
from utils import make_actor, make_environment, make_loss

from torchrl_ecpo.checks import check_count
from torchrl_ecpo.experiment import restore_part
from torchrl_ecpo.experiment._videos import show


def main(arguments: Sequence[str] | None = None) -> None:
    """Play, and say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a run")
    parser.add_argument("--episodes", type=int, default=5, help="default 5")
    options = parser.parse_args(arguments)
    try:
        check_count("--episodes", options.episodes)
        directory = options.run.resolve()
        config: Any = OmegaConf.load(directory / "config.yaml")
        if not {"total_frames", "collector"} <= config.keys():
            raise ValueError(f"{directory} is no run of ecac.py.")
        make = partial(make_environment, config, seed=config.seed + 1_000_000)
        env = make()
        actor = make_actor(config, env)
        restore_part(directory, "loss_module", make_loss(config, actor, env))
        show(make, actor, options.episodes, directory, config.env.title)
    except (CheckpointError, FileNotFoundError, ValueError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
