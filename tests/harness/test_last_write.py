import errno
from pathlib import Path

import pytest

from lodbench.errors import DatasetError
from lodbench.harness.tracebacks import last_write


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/data/.a.csv.12345678.lodbench.part"),
            "a.csv: No space",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), "out: No space left on device"),
        (DatasetError("out is a file.", "Choose another."), "out is a file"),
    ],
)
def test_a_write_that_fails_on_the_way_out_does_not_hide_why_the_work_ended(fault, told, caplog):
    def work():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            with last_write(Path("out")):
                raise fault from None
            raise

    with pytest.raises(KeyboardInterrupt):
        work()
    assert "what was done until then could not be kept" in caplog.text
    assert told in caplog.text
