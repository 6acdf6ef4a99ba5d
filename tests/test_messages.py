"""Every mistake is answered as the catalogue has it: one line, a hint, nothing written, code 2."""

from pathlib import Path

import pytest

from tests import messages

CATALOGUE = dict(messages.catalogue())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return messages.prepare(tmp_path_factory.mktemp("messages") / "typed here")


@pytest.mark.parametrize("command", CATALOGUE)
def test_a_mistake_is_answered_as_catalogued(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert messages.answer(command, folder) == CATALOGUE[command]


def test_answers_are_a_line_and_a_hint():
    for command, text in CATALOGUE.items():
        first, *more = text.splitlines()
        assert first.startswith("lodbench: "), command
        assert len(more) <= 1, command
        assert all(line.startswith("  hint: ") for line in more), command
