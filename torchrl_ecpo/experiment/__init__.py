"""What every script needs and no loss knows: run directories, loggers, curves and figures."""

from torchrl_ecpo.experiment.checkpoint import Checkpoints, Progress
from torchrl_ecpo.experiment.compiling import compile_module
from torchrl_ecpo.experiment.run import MetricsTable, Run, check_options, read_metrics

__all__ = [
    "Checkpoints",
    "MetricsTable",
    "Progress",
    "Run",
    "check_options",
    "compile_module",
    "read_metrics",
]
