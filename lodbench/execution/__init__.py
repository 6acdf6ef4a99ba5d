"""Long work: progress with time left, and a ledger to resume from."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.execution.progress import Ledger as Ledger
    from lodbench.execution.progress import Progress as Progress
    from lodbench.execution.progress import ProgressCallback as ProgressCallback

__all__, __getattr__, __dir__ = lazy_names(
    __name__, {"Ledger": "progress", "Progress": "progress", "ProgressCallback": "progress"}
)
