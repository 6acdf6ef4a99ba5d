"""What goes to the workers of a Dask cluster, and between them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from lodbench.execution.cluster import DaskWorkers, _on_worker, dask_workers


class Segmenter:
    """As those of photos: loads what no other process can be sent, once it is asked."""

    def __init__(self) -> None:
        self.network: Any = None


_at_work: list[Segmenter] = []


def load(segmenter: Segmenter) -> None:
    segmenter.network = threading.Lock()
    _at_work[:] = [segmenter]


def is_loaded(_: int) -> bool:
    return _at_work[0].network is not None


class OneWorker:
    """A client whose one worker is this process, and which keeps what it is handed."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def submit(self, work: Callable[..., Any], *items: Any, **_: Any) -> Any:
        self.kept.append(work(*items))
        return self.kept[-1]


def test_what_a_worker_was_prepared_with_can_be_handed_to_the_next() -> None:
    """Workers fetch it from one another: one that could not be sent left the second waiting for ever."""
    protocol = pytest.importorskip("distributed.protocol.pickle")
    client = OneWorker()
    DaskWorkers(client, "here", load, (Segmenter(),), 1, 1.0)
    (common,) = client.kept
    assert _on_worker(common, is_loaded, 0)
    _, preparation = protocol.loads(protocol.dumps(common))
    assert isinstance(preparation, bytes)


def test_the_dashboard_is_for_this_machine_alone() -> None:
    pytest.importorskip("distributed")
    with dask_workers(None, 1, 60.0, load, (Segmenter(),)) as workers:
        server = workers._client.cluster.scheduler.http_server
        listeners = [socket.getsockname()[0] for socket in server._sockets.values()]
        assert listeners
        assert set(listeners) == {"127.0.0.1"}
