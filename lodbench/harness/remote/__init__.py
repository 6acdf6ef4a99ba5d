"""Methods in another environment: a process of another Python answers over pipes, by the same protocol."""

from lodbench.harness.remote.method import RemoteMethod, RunnerParams

__all__ = ["RemoteMethod", "RunnerParams"]
