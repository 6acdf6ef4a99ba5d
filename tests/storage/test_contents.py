"""Files that are read again must hold what they held when they were hashed."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lodbench.errors import InputChanged
from lodbench.storage.digest import (
    content_digest,
    known_contents,
    read_content,
    remember_contents,
    remembered_contents,
)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mask.png"
    path.write_bytes(b"as it was")
    return path


def test_what_changed_since_it_was_hashed_is_not_read(file):
    with remembered_contents():
        assert content_digest(file) == hashlib.sha256(b"as it was").hexdigest()
        assert read_content(file) == b"as it was"
        file.write_bytes(b"as it is.")
        with pytest.raises(InputChanged, match=r"mask\.png changed"):
            read_content(file)
        file.write_bytes(b"as it was")
        assert read_content(file) == b"as it was"


def test_a_digest_is_that_of_the_first_look_and_anew_in_a_scope_of_its_own(file):
    with remembered_contents():
        first = content_digest(file)
        file.write_bytes(b"as it is.")
        assert content_digest(file) == first
        with remembered_contents():
            assert content_digest(file) == hashlib.sha256(b"as it is.").hexdigest()
        assert known_contents() == {file: first}
    assert known_contents() == {}
    assert read_content(file) == b"as it is."


def test_a_file_never_hashed_is_just_read_and_one_that_is_not_there_has_a_word(file):
    with remembered_contents():
        assert read_content(file) == b"as it was"
        assert content_digest(Path("nowhere.png")) == "unreadable"
        assert content_digest(None) is None
        with pytest.raises(FileNotFoundError):
            read_content(Path("nowhere.png"))


def test_a_worker_compares_with_what_another_process_found(file):
    remember_contents({file: hashlib.sha256(b"something else").hexdigest()})
    try:
        with pytest.raises(InputChanged):
            read_content(file)
        with remembered_contents():  # a run of its own knows its own files
            assert read_content(file) == b"as it was"
    finally:
        remember_contents({})
    assert read_content(file) == b"as it was"


def test_runs_in_threads_do_not_mix_what_they_remember(file, tmp_path):
    def digest_and_read(name):
        with remembered_contents():
            content_digest(file)
            (tmp_path / name).write_bytes(name.encode())
            content_digest(tmp_path / name)
            return known_contents().keys() - {file}

    with ThreadPoolExecutor(4) as pool:
        names = [f"{number}.png" for number in range(20)]
        assert list(pool.map(digest_and_read, names)) == [{tmp_path / name} for name in names]


def test_a_wanted_digest_goes_before_what_is_remembered(file):
    with pytest.raises(InputChanged):
        read_content(file, hashlib.sha256(b"something else").hexdigest())
    assert read_content(file, hashlib.sha256(b"as it was").hexdigest()) == b"as it was"
