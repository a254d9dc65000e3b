"""What every script needs and no loss knows: run directories, loggers, curves and figures."""

from torchrl_ecpo.experiment.run import MetricsTable, Run, read_metrics

__all__ = ["MetricsTable", "Run", "read_metrics"]
