"""Long work: progress with time left, and a ledger to resume from."""

from lodbench.execution.ledger import Ledger
from lodbench.execution.progress import Progress, ProgressCallback

__all__ = ["Ledger", "Progress", "ProgressCallback"]
