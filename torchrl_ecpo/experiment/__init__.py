"""What every script needs and no loss knows: run directories, loggers, curves and figures."""

from typing import TYPE_CHECKING

from torchrl_ecpo._lazy import importing

if TYPE_CHECKING:
    from torchrl_ecpo.experiment.checkpoint import Checkpoints, Progress, restore_part
    from torchrl_ecpo.experiment.compiling import compile_module
    from torchrl_ecpo.experiment.options import check_command_line, compose_options
    from torchrl_ecpo.experiment.run import (
        MetricsTable,
        Run,
        leaving_nothing,
        read_metrics,
        refuse_resume,
    )

__all__ = [
    "Checkpoints",
    "MetricsTable",
    "Progress",
    "Run",
    "check_command_line",
    "compile_module",
    "compose_options",
    "leaving_nothing",
    "read_metrics",
    "refuse_resume",
    "restore_part",
]

__getattr__ = importing(__name__, "checkpoint", "compiling", "options", "run")
