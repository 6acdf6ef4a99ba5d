"""Files written safely, random streams, digests, and where data and caches live."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.storage.atomic import new_folder as new_folder
    from lodbench.storage.atomic import remove_leftovers as remove_leftovers
    from lodbench.storage.atomic import scratch_folder as scratch_folder
    from lodbench.storage.atomic import write_bytes as write_bytes
    from lodbench.storage.atomic import write_chunks as write_chunks
    from lodbench.storage.atomic import write_text as write_text
    from lodbench.storage.digest import digest_of as digest_of
    from lodbench.storage.digest import file_digest as file_digest
    from lodbench.storage.disk import can_write as can_write
    from lodbench.storage.disk import make_folder as make_folder
    from lodbench.storage.json_text import hide_formula as hide_formula
    from lodbench.storage.json_text import show_formula as show_formula
    from lodbench.storage.streams import random_stream as random_stream

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "can_write": "disk",
        "digest_of": "digest",
        "file_digest": "digest",
        "hide_formula": "json_text",
        "make_folder": "disk",
        "new_folder": "atomic",
        "random_stream": "streams",
        "remove_leftovers": "atomic",
        "scratch_folder": "atomic",
        "show_formula": "json_text",
        "write_bytes": "atomic",
        "write_chunks": "atomic",
        "write_text": "atomic",
    },
)
