"""Weights are where a setting says, and what it pins them to."""

import hashlib

import pytest

from lodbench.errors import ConfigError
from lodbench.matching.weights import Published, fetched_folder, named_file

PUBLISHED = Published("someone/something", "Apache-2.0", 3)
CONTENT = b"numbers"
RIGHT, WRONG = hashlib.sha256(CONTENT).hexdigest(), 64 * "0"


def test_a_pinned_file_or_folder_is_taken_if_it_is_the_one(tmp_path):
    file = tmp_path / "net.safetensors"
    file.write_bytes(CONTENT)
    assert named_file(f"{file}#sha256={RIGHT}") == named_file(str(file)) == file
    assert fetched_folder(f"{tmp_path}#sha256={RIGHT}", PUBLISHED) == tmp_path
    for take in (
        lambda: named_file(f"{file}#sha256={WRONG}"),
        lambda: fetched_folder(f"{tmp_path}#sha256={WRONG}", PUBLISHED),
    ):
        with pytest.raises(ConfigError, match=f"have the sha256 {RIGHT}, not {WRONG}"):
            take()
    with pytest.raises(ConfigError, match="is no SHA-256"):
        named_file(f"{file}#sha256=12")
    (tmp_path / "second.safetensors").write_bytes(b"")
    with pytest.raises(ConfigError, match="has 2 files"):
        fetched_folder(f"{tmp_path}#sha256={RIGHT}", PUBLISHED)


def test_what_was_not_fetched_is_told_with_its_licence_and_size(monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for weights in (None, f"someone/something#sha256={RIGHT}"):
        with pytest.raises(ConfigError, match=r"someone/something.*Apache-2\.0; 3 MB"):
            fetched_folder(weights, PUBLISHED)
