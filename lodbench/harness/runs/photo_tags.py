"""Tags that people give photos on the page of two runs, in a file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lodbench.errors import DatasetError
from lodbench.storage.json_text import parse_json

_ENDING = ".tags.json"
_HINT = "Export it from the page again, or move it away."


def tags_file_of(page: Path | None) -> Path:
    """Returns the file of a page's tags, which is beside it; of a page without a name a relative one."""
    return Path(f"compared{_ENDING}") if page is None else page.with_name(f"{page.stem}{_ENDING}")


def read_tags(file: Path, dataset: Mapping[str, Any]) -> dict[str, list[str]]:
    """Returns tags by ``split/query``; none where there is no file.

    Args:
        file: As the page exports it.
        dataset: Name and version of the dataset that the page shows.

    Raises:
        DatasetError: The file cannot be read, holds no tags, or those of another dataset.
    """
    if not file.exists():
        return {}
    try:
        content = parse_json(file.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file} cannot be read: {error}.", _HINT) from error
    tags = content.get("tags") if isinstance(content, dict) else None
    if not isinstance(tags, dict) or not all(
        isinstance(words, list) and all(isinstance(word, str) for word in words) for words in tags.values()
    ):
        raise DatasetError(f"{file} holds no tags by photo.", _HINT)
    of, shown = (
        f"{each.get('dataset', each.get('name'))} {each.get('version')}".strip()
        for each in (content, dataset)
    )
    if of != shown:
        raise DatasetError(
            f"{file} holds tags of the dataset {of}, and the runs are of {shown}.",
            "Write the page under another name with --out, or move the file away.",
        )
    return tags
