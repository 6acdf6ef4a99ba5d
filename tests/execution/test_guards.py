"""A folder for one process at a time; BLAS on one thread while results are made."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - its BLAS is one of its own
from threadpoolctl import threadpool_info, threadpool_limits

from lodbench.execution.processes import only_one_in, single_threaded_blas

pytestmark = pytest.mark.attack

CODE = (
    "import sys; from pathlib import Path; from lodbench.execution.processes import only_one_in\n"
    "with only_one_in(Path(sys.argv[1])): print('in', flush=True)\n"
)


def test_a_second_process_waits_and_says_so(tmp_path):
    command = [sys.executable, "-c", CODE, str(tmp_path)]
    with only_one_in(tmp_path):
        second = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert f"Another process is at work in {tmp_path}: waiting" in second.stderr.readline()
        assert second.poll() is None
    assert second.communicate(timeout=60)[0] == "in\n"
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_holds_nothing(tmp_path):
    code = CODE.replace("print('in', flush=True)", "import os; os.kill(os.getpid(), 9)")
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == -9
    done = subprocess.run([sys.executable, "-c", CODE, str(tmp_path)], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("in\n", "")


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@single_threaded_blas
def threads_inside() -> set[int]:
    return threads()


@single_threaded_blas
def nested() -> tuple[set[int], set[int]]:
    return threads_inside(), threads()


@single_threaded_blas
def broken() -> None:
    raise ValueError("no")


def test_one_inside_and_as_before_after() -> None:
    with threadpool_limits(3, "blas"):
        assert threads() == {3}
        assert threads_inside() == {1}
        assert nested() == ({1}, {1})
        with pytest.raises(ValueError, match="no"):
            broken()
        assert threads() == {3}


def test_threads_that_overlap_restore_what_was_before_the_first() -> None:
    inside, leave, seen = threading.Event(), threading.Event(), []

    @single_threaded_blas
    def first() -> None:
        inside.set()
        leave.wait(10)

    @single_threaded_blas
    def second() -> None:
        leave.set()
        other.join(10)
        # The first has left; it is not the last.
        seen.append(threads())

    with threadpool_limits(3, "blas"):
        other = threading.Thread(target=first)
        other.start()
        assert inside.wait(10)
        second()
        assert seen == [{1}]
        assert threads() == {3}


def test_a_blas_that_is_loaded_inside_has_one_thread_and_later_ones_as_many_as_before() -> None:
    script = """
import os
from threadpoolctl import threadpool_info
from lodbench.execution.processes import single_threaded_blas

@single_threaded_blas
def inside():
    import scipy.linalg
    return sorted(library["num_threads"] for library in threadpool_info())

print(inside(), os.environ.get("OPENBLAS_NUM_THREADS"), inside())
"""
    known = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=known)
    assert done.stdout.split("\n")[0] == "[1, 1] None [1, 1]"


def test_sums_do_not_depend_on_the_threads_there_are() -> None:
    values = np.random.default_rng(0).normal(size=(200_003, 12))
    product = single_threaded_blas(
        lambda: (values.T @ values, values.T @ values[:, 0], values[:, 0] @ values[:, 1])
    )
    with threadpool_limits(1, "blas"):
        expected = product()
    with threadpool_limits(4, "blas"):
        found = product()
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
