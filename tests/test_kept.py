"""What is kept between checkouts is taken by its digest alone, and nothing needs it."""

import pytest

from tests import kept


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout with kernels' code, and a cache of its own."""
    root = tmp_path / "checkout"
    (root / "lodbench" / "kernels").mkdir(parents=True)
    (root / "lodbench" / "kernels" / "one.py").write_text("A = 1\n")
    for name in ("constraints.txt", "pyproject.toml"):
        (root / name).write_text(name)
    monkeypatch.setattr(kept, "ROOT", root)
    monkeypatch.setattr(kept, "HOME", tmp_path / "cache" / "lodbench-tests")
    monkeypatch.setattr(kept.compiled, "code_digest", kept.compiled.code_digest.__wrapped__)
    return root


def test_the_same_state_takes_what_was_kept_and_another_does_not(checkout):
    kept.restore()
    kernels, mypy = kept.places()
    assert not kernels.exists()
    kernels.mkdir(mode=0o700, parents=True)
    (kernels / "one.nbi").write_text("compiled")
    mypy.mkdir()
    kept.keep()
    (kernels / "one.nbi").unlink()
    kernels.rmdir()
    kept.restore()
    assert (kernels / "one.nbi").read_text() == "compiled"
    assert kernels.stat().st_mode & 0o777 == 0o700
    (checkout / "lodbench" / "kernels" / "one.py").write_text("A = 2\n")
    kept.restore()
    assert not next(iter(kept.places())).exists()


def test_what_is_there_stays_and_the_oldest_goes(checkout):
    _, mypy = kept.places()
    mypy.mkdir()
    for number in range(kept.MOST + 2):
        (checkout / "constraints.txt").write_text(str(number))
        (mypy / "state").write_text(str(number))
        kept.keep()
    assert len(list(kept.HOME.glob("mypy-*"))) == kept.MOST
    (mypy / "state").write_text("newer")
    kept.restore()
    assert (mypy / "state").read_text() == "newer"


def test_a_folder_of_another_user_is_not_taken(checkout, tmp_path, monkeypatch):
    (tmp_path / "strange").mkdir()
    monkeypatch.setattr(kept.os, "getuid", lambda: 4711)
    assert not kept.copied(tmp_path / "strange", tmp_path / "here")
