"""Files written safely, random streams, digests, and where data and caches live."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.storage.digest import digest_of as digest_of
    from lodbench.storage.digest import file_digest as file_digest
    from lodbench.storage.digest import random_stream as random_stream
    from lodbench.storage.disk import can_write as can_write
    from lodbench.storage.disk import make_folder as make_folder
    from lodbench.storage.disk import new_folder as new_folder
    from lodbench.storage.disk import remove_leftovers as remove_leftovers
    from lodbench.storage.disk import scratch_folder as scratch_folder
    from lodbench.storage.disk import write_bytes as write_bytes
    from lodbench.storage.disk import write_chunks as write_chunks
    from lodbench.storage.disk import write_text as write_text
    from lodbench.storage.json_text import hide_formula as hide_formula
    from lodbench.storage.json_text import show_formula as show_formula

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "can_write": "disk",
        "digest_of": "digest",
        "file_digest": "digest",
        "hide_formula": "json_text",
        "make_folder": "disk",
        "new_folder": "disk",
        "random_stream": "digest",
        "remove_leftovers": "disk",
        "scratch_folder": "disk",
        "show_formula": "json_text",
        "write_bytes": "disk",
        "write_chunks": "disk",
        "write_text": "disk",
    },
)
