"""From settings, or the words of a command, to a frozen dataclass, names and types checked: the one place.

Options of a command are fields of a dataclass, each declared once with its type, default and help. The type
says how words are read: ``bool`` is a switch, ``tuple[X, ...]`` may be repeated, or is an argument of
several words, ``tuple[X, X, X]`` takes three words, and all else one. ``None`` and ``()`` mean that nothing
was given. A field made by ``part`` is another such dataclass, with options of its own.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from lodbench.errors import ConfigError, nearest_names, require_within

T = TypeVar("T")
# What OmegaConf says of a value, and what a reader is told instead: kinds and examples of them.
_NOT_CONVERTED = re.compile(
    r"Value '(?P<value>.*)' (?:of type '\w+' could not be converted to|is not a valid) "
    r"(?P<kind>Integer|Float|bool)\b.*"
)
_KINDS = {"Integer": ("a whole number", "2"), "Float": ("a number", "2.5"), "bool": ("true or false", "true")}


def to_params(values: Mapping[str, Any], params_type: type[T], prefix: str) -> T:
    """Returns a frozen Params made from plain values; what they leave out keeps its default.

    One value stands for a list of one: ``split=in_place``, or ``pitch=30``.

    Args:
        values: Settings by name.
        params_type: A dataclass of types that OmegaConf knows.
        prefix: What settings are called with on a command line, as ``method`` in ``method.steps``.

    Raises:
        ConfigError: A name is unknown, or a value has the wrong type or too few or too many parts.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    types = {f.name: f.type for f in fields(params_type)}  # type: ignore[arg-type]
    for name in values:
        if name not in types:
            raise ConfigError(f"`{_dotted(prefix, name)}` is not a setting.", nearest_names(name, types))
    given = _as_typed(values, params_type, prefix)
    try:
        merged = OmegaConf.merge(_writable(OmegaConf.structured(params_type)), _literal(given))
        return cast("T", OmegaConf.to_object(merged))
    except MissingMandatoryValue as error:
        name = _dotted(prefix, str(error.full_key))
        raise ConfigError(f"`{name}` is not set.", f"Add `{name}=VALUE`.") from error
    except OmegaConfBaseException as error:
        raise _not_of_its_kind(_dotted(prefix, str(error.full_key)), str(error).splitlines()[0]) from error


def read_settings(text: str) -> dict[str, Any]:
    """Returns the settings of a YAML text by name, as plain values."""
    from omegaconf import OmegaConf

    return cast("dict[str, Any]", OmegaConf.to_container(OmegaConf.create(text)))


def _not_of_its_kind(name: str, reason: str) -> ConfigError:
    """Returns the fault of a setting whose value OmegaConf does not take for the reason that it gives."""
    match = _NOT_CONVERTED.fullmatch(reason)
    if match is None and "to Dict[" in reason:
        return ConfigError(f"`{name}` holds settings.", f"Write `{name}.KEY=VALUE`.")
    if match is None:
        return ConfigError(f"`{name}`: {reason}")
    kind, example = _KINDS[match["kind"]]
    base, index, _ = name.partition("[")
    written = f"[{example}]" if index else example
    value = match["value"] or "empty"
    return ConfigError(f"`{name}` is {value}, not {kind}.", f"Write `{base}={written}`, for instance.")


def _as_typed(values: Mapping[str, Any], params_type: type, prefix: str) -> dict[str, Any]:
    """Returns values, those of groups too, with words as they were typed, and lists of the right length."""
    hints, typed = get_type_hints(params_type), {}
    for name, value in values.items():
        wanted, dotted = hints.get(name, Any), _dotted(prefix, name)
        is_group = isinstance(value, Mapping) and isinstance(wanted, type) and is_dataclass(wanted)
        typed[name] = _as_typed(value, wanted, dotted) if is_group else _typed(value, wanted, dotted)
    return typed


def _typed(value: Any, wanted: Any, name: str) -> Any:
    """Returns one value; raises ConfigError if it has not as many parts as a tuple of so many."""
    if isinstance(value, bool) and wanted in (str, str | None, list[str]):
        value = str(value).lower()  # a ``true`` where a name is wanted is no boolean
    parts, is_one = _parts(wanted), isinstance(value, str | int | float)
    if not parts or not (is_one or isinstance(value, list | tuple)):
        return value
    if parts[-1] is ...:
        return [str(value) if parts[0] is str else value] if is_one else value
    count = 1 if is_one else len(value)
    if count != len(parts):
        written = value if is_one else str(list(value)).replace(" ", "")
        example = ",".join(["VALUE"] * len(parts))
        raise ConfigError(
            f"`{name}={written}` has {count} {'value' if count == 1 else 'values'}, not {len(parts)}.",
            f"Give it as a list: `{name}=[{example}]`",
        )
    return value


def _parts(wanted: Any) -> tuple[Any, ...]:
    """Returns the types of a list's parts, ``...`` last where any number will do; none for other types."""
    for kind in get_args(wanted) if get_origin(wanted) in (Union, UnionType) else (wanted,):
        if get_origin(kind) in (list, tuple):
            return (*get_args(kind), ...) if get_origin(kind) is list else get_args(kind)
    return ()


def _dotted(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def _writable(node: Any) -> Any:
    """Returns the tree of a structured config whose groups take values: those of frozen classes take none."""
    from omegaconf import OmegaConf

    OmegaConf.set_readonly(node, False)
    for key in node:
        if not OmegaConf.is_missing(node, key) and OmegaConf.is_dict(node[key]):
            _writable(node[key])
    return node


def _literal(value: Any) -> Any:
    """Returns values whose strings are taken as they stand: they are resolved already."""
    if isinstance(value, str):
        return value.replace("${", "\\${")
    if isinstance(value, dict):
        return {key: _literal(item) for key, item in value.items()}
    return [_literal(item) for item in value] if isinstance(value, list | tuple) else value


def flag(default: Any, meaning: str | None, *flags: str, **named: Any) -> Any:
    """Returns a field that is an option, ``--its-name`` unless flags are given.

    Args:
        default: Its default; ``...`` where it must be given.
        meaning: Its help.
        flags: What it is called.
        named: As of ``add_argument``, where the field's type does not say it. ``apart``: it stands before the
            heading of its part; ``old``: its former name; ``sets``: the settings of the library that it sets,
            by which messages name it; ``either``: what those of which one is given have in common, one must
            be where their default is ``...``.
    """
    return field(default=default, metadata={"help": meaning, "flags": flags, **named})


def word(meaning: str, default: Any = ..., **named: Any) -> Any:
    """Returns a field that is a word, or several, without a flag."""
    return field(default=default, metadata={"help": meaning, "flags": None, **named})


def part(kind: type, title: str = "") -> Any:
    """Returns a field that holds other options, below a heading of their own if it has a title."""
    return field(default=None, metadata={"part": kind, "title": title})


def add_options(parser: argparse.ArgumentParser, kind: type, title: str = "") -> None:
    """Adds the options of a dataclass to a parser, in the order of its fields."""
    hints, groups = get_type_hints(kind), dict[str, Any]()
    for each in fields(kind):
        if "part" in each.metadata:
            add_options(parser, each.metadata["part"], each.metadata["title"])
        elif each.metadata:
            _add_option(parser, groups, each, hints[each.name], title)


def _add_option(
    parser: argparse.ArgumentParser, groups: dict[str, Any], each: Field[Any], hint: Any, title: str
) -> None:
    """Adds one option, below the title, if there is one, and beside those of which only one is given."""
    declared = {name: value for name, value in each.metadata.items() if name != "sets"}
    flags, is_apart, old, either = (declared.pop(name, None) for name in ("flags", "apart", "old", "either"))
    named = _by_type(hint, flags is None) | declared
    if flags is None:
        if each.default is not ...:
            named["default"] = each.default
        parser.add_argument(each.name, **named)
        return
    place: Any = parser
    if title and not is_apart:
        place = groups[title] = groups.get(title) or parser.add_argument_group(title)
    if each.default is ... and either is None:
        named["required"] = True
    elif each.default not in (None, (), False, ...):
        named["default"] = each.default
    if either is not None:
        is_required = each.default is ...
        place = groups[either] = groups.get(either) or place.add_mutually_exclusive_group(
            required=is_required
        )
    place.add_argument(*(flags or (_flag(each),)), dest=each.name, **named)
    if old is not None:
        place.add_argument(old, dest=each.name, action="former")


def options_of(given: argparse.Namespace, kind: type[T]) -> T:
    """Returns the dataclass with what a parser of its options was given.

    Raises:
        LodbenchError: A number is not finite, or as its ``__post_init__``.
    """
    values = {}
    for each in fields(cast("Any", kind)):
        if "part" in each.metadata:
            values[each.name] = options_of(given, each.metadata["part"])
        elif each.metadata:
            value, default = getattr(given, each.name), None if each.default is ... else each.default
            values[each.name] = default if value is None else _frozen(value)
    options = kind(**values)
    for each in fields(cast("Any", kind)):  # after its own bounds, which say more
        if each.name not in values:
            continue
        numbers = [number for number in _flat(values[each.name]) if isinstance(number, float)]
        require_within((each.metadata.get("flags") or (_flag(each),))[0], numbers, -math.inf)
    return options


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _flat(value: Any) -> Iterator[Any]:
    for each in value if isinstance(value, list | tuple) else [value]:
        yield from _flat(each) if isinstance(each, list | tuple) else [each]


def flags_of(kind: type) -> dict[str, str]:
    """Returns the flags by which a command sets what a message names by its setting."""
    flags: dict[str, str] = {}
    for each in _all(kind):
        sets: Sequence[str] = each.metadata.get("sets", ())
        flags |= dict.fromkeys(sets, (each.metadata["flags"] or (_flag(each),))[0])
    return flags


def _all(kind: type) -> Iterator[Field[Any]]:
    for each in fields(kind):
        if "part" in each.metadata:
            yield from _all(each.metadata["part"])
        elif each.metadata:
            yield each


def _flag(each: Field[Any]) -> str:
    return f"--{each.name.replace('_', '-')}"


def _by_type(hint: Any, is_word: bool) -> dict[str, Any]:
    """Returns what ``add_argument`` takes of a field's type."""
    plain = [each for each in get_args(hint) if each is not NoneType]
    kind = plain[0] if NoneType in get_args(hint) else hint
    if kind is bool:
        return {"action": "store_true"}
    if get_origin(kind) is tuple:
        of, *more = get_args(kind)
        read = {} if of is str else {"type": of}
        if more != [...]:
            return {"nargs": 1 + len(more), **read}
        return {"nargs": "+", **read} if is_word else {"action": "append", "default": [], **read}
    return {"type": kind} if kind in (int, float, Path) else {}


def parsed(parser: argparse.ArgumentParser, argv: Sequence[str], kind: type[T]) -> T:
    """Returns what words say, by a parser that gets the options of a dataclass.

    Raises:
        LodbenchError: A word is wrong, or one is missing.
    """
    add_options(parser, kind)
    return options_of(parser.parse_args(argv), kind)
