import subprocess
import sys

import pytest

from lodbench.execution.guards import only_one_in

pytestmark = pytest.mark.attack

CODE = (
    "import sys; from pathlib import Path; from lodbench.execution.guards import only_one_in\n"
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
