"""Methods: from a query and a map to a pose. The paper's and lodbench's own; others' are in ``baselines``.

``protocol`` says what a method is and where it keeps what it prepares, ``registry`` finds it by name,
``localize`` calls it, ``assessment`` says how far to trust its answers; ``search`` is what
methods share that search about a prior.
"""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.datasets.inputs import Input as Input
    from lodbench.methods.protocol import Estimate as Estimate
    from lodbench.methods.protocol import Method as Method
    from lodbench.methods.protocol import Streams as Streams

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Estimate": "protocol",
        "Input": ".datasets.inputs",
        "Method": "protocol",
        "Streams": "protocol",
    },
)
