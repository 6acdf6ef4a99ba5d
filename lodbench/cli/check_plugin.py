"""`lodbench check-plugin KIND NAME`, `check-method NAME`: does it keep to the protocol of its kind?"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from lodbench.checks import FAULT, OK, Check
from lodbench.cli.configs import composed, config_files, read_config
from lodbench.cli.hydra_app import explained, register_config_sources, section
from lodbench.cli.parser import Parser, check_lines, plain_check, traceback_lines
from lodbench.cli.parts import option_pairs
from lodbench.cli.run_dataset import remote_checks
from lodbench.errors import STOPPED, ConfigError, LodbenchError, nearest_names
from lodbench.methods.conformance import check_answers, check_class
from lodbench.params import to_params
from lodbench.plugins import KINDS, PlugIn, find_plugin
from lodbench.reporting.aligned_text import count_of

_SOURCE = "source"
# Kinds that read files of a user's.
_OF_SAMPLES = ("city-reader", "pose-format")
_EPILOG = """\
docs/plugins.md has an example of each kind, and says what its check proves. Exit code: 0 it conforms to
the protocol, 1 it does not, 2 there is no such plug-in, setting or sample.
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no such kind, plug-in, setting or sample.
    """
    kinds = {kind.label: group for group, kind in KINDS.items()}
    parser = Parser("lodbench check-plugin", "Check a plug-in against the protocol of its kind.", _EPILOG)
    parser.add_argument("kind", metavar="KIND", help=f"{', '.join(kinds)} or {_SOURCE}")
    parser.add_argument("name", metavar="NAME", help="the name of its entry point")
    parser.add_argument(
        "settings",
        nargs="*",
        default=[],
        metavar="KIND.KEY=VALUE",
        help="of a segmenter, dataset or prior, as of a run: segmenter.weights=FILE",
    )
    parser.add_argument(
        "--sample", type=Path, metavar="FILE", help="of a city-reader or pose-format: a file to read"
    )
    parser.add_argument("--json", action="store_true", help="one check per line, for machines")
    options = parser.parse_args(argv)
    _require_sample(options.kind, options.sample)
    if options.kind == "method":
        return main_method([options.name, *options.settings, *(["--json"] if options.json else [])])
    if options.kind not in (*kinds, _SOURCE):
        raise ConfigError(
            f"There is no kind {options.kind!r}.", nearest_names(options.kind, [*kinds, _SOURCE])
        )
    from lodbench.harness.conformance.checks import CONFIGURED

    if options.settings and kinds.get(options.kind) not in CONFIGURED:
        hint = f"Leave {options.settings[0]} out."
        raise ConfigError(f"A {options.kind} is checked without settings.", hint)
    # What the plug-in prints is no line of the report's.
    with redirect_stdout(sys.stderr):
        if options.kind == _SOURCE:
            checks = list(_source_checks(options.name))
        else:
            checks = list(_checks(kinds[options.kind], options.name, options.settings, options.sample))
    faults = [check for check in checks if check.status != OK]
    if options.json:
        lines = [json.dumps(asdict(check)) for check in checks]
    else:
        verdict = "violates the protocol" if faults else "conforms to the protocol"
        lines = [*check_lines([*map(plain_check, checks)]), "", *traceback_lines(faults)]
        lines.append(f"{options.name} {verdict}.")
    sys.stdout.write("".join(line + "\n" for line in lines))
    return 1 if faults else 0


def _require_sample(kind: str, sample: Path | None) -> None:
    """Makes sure that a sample that was named is there, and is looked at."""
    if sample is None:
        return
    if kind not in _OF_SAMPLES:
        raise ConfigError(f"A {kind} reads no sample.", "Leave --sample out.")
    if not sample.exists():
        raise ConfigError(f"There is no sample {sample}.", "Check the path.")


def _checks(group: str, name: str, settings: Sequence[str], sample: Path | None) -> Iterator[Check]:
    from lodbench.harness.conformance.checks import CONFIGURED, check_plugin, require_settings

    plug_in = find_plugin(group, name)
    try:
        config = read_config(CONFIGURED[group], name) if group in CONFIGURED else None
    except ConfigError as error:
        yield Check("plug-in", "configuration", FAULT, error.message, error.hint)
        return
    if config is not None and settings:
        config |= _settings(settings, CONFIGURED[group])
        require_settings(plug_in, config)
    yield from check_plugin(plug_in, config, sample)


def _settings(words: Sequence[str], section: str) -> dict[str, Any]:
    """Returns the values of settings written as ``section.key=value``."""
    for word in words:
        if not word.startswith(f"{section}."):
            raise ConfigError(f"{word} is not a setting of a {section}.", f"Write {section}.KEY=VALUE.")
    return option_pairs([word.removeprefix(f"{section}.") for word in words])


def _source_checks(name: str) -> Iterator[Check]:
    """Yields whether a profile can be read, its options are options, and its reader there is."""
    from lodbench.cli.parts import load_profile

    if name not in config_files(_SOURCE):
        raise ConfigError(f"There is no source {name!r}.", nearest_names(name, config_files(_SOURCE)))
    try:
        profile = load_profile(name)
        reader = profile.options.reader
        if reader is not None:
            find_plugin("city_readers", reader).load()
    except LodbenchError as error:
        yield Check("plug-in", "profile", FAULT, error.message, error.hint)
        return
    except Exception as error:  # a file may hold anything
        yield Check(
            "plug-in", "profile", FAULT, f"{config_files(_SOURCE)[name]}: {type(error).__name__}: {error}"
        )
        return
    yield Check("plug-in", "profile", OK, f"{config_files(_SOURCE)[name]}, reader {reader or 'by content'}")


_EPILOG_OF_METHODS = """\
A method is an entry point under lodbench.methods, with conf/method/NAME.yaml: see CONTRIBUTING.md, "Add a
method". It localises three photos of seven blocks, with exact masks, several times.
Settings are those of a run: lodbench check-method lodlocv2 method.variant=no_refine
In another environment: lodbench check-method NAME runner.python=PATH
Exit code: 0 it conforms to the protocol, 1 it does not, 2 there is no such method or setting.
"""


def main_method(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no such method or setting.
    """
    parser = Parser(
        "lodbench check-method",
        "Check a method against the protocol: its class, its configuration, its answers.",
        _EPILOG_OF_METHODS,
    )
    parser.add_argument("name", metavar="NAME", help="the method's name, as in method=NAME")
    parser.add_argument(
        "settings", nargs="*", default=[], metavar="method.KEY=VALUE", help="settings of the method to try"
    )
    parser.add_argument("--json", action="store_true", help="one check per line, for machines")
    options = parser.parse_args(argv)
    for word in options.settings:
        if not word.startswith(("method.", "runner.")):
            raise ConfigError(f"{word} is not a setting of a method.", "Write method.KEY=VALUE.")
    # What the method prints is no line of the report's.
    with redirect_stdout(sys.stderr):
        if any(word.startswith("runner.") for word in options.settings):
            checks = list(remote_checks(options.name, options.settings))
        else:
            checks = list(_method_checks(find_plugin("methods", options.name), options.settings))
    faults = [check for check in checks if check.status != OK]
    if options.json:
        lines = [json.dumps(asdict(check)) for check in checks]
    else:
        verdict = (
            f"violates {count_of(len(faults), 'rules')} of the protocol"
            if faults
            else "conforms to the protocol"
        )
        lines = [*check_lines([*map(plain_check, checks)]), "", *traceback_lines(faults)]
        lines.append(f"{options.name} {verdict}.")
    sys.stdout.write("".join(line + "\n" for line in lines))
    return 1 if faults else 0


def _method_checks(plug_in: PlugIn, settings: Sequence[str]) -> Iterator[Check]:
    try:
        kind = plug_in.load()
    except LodbenchError as error:
        hint = "It is module:Class, and importing it must work."
        yield Check("plug-in", "entry point", FAULT, error.message, hint)
        return
    yield Check("plug-in", "entry point", OK, f"{plug_in.point.value} of {plug_in.package}")
    where = f"conf/method/{plug_in.name}.yaml"
    load = partial(_configuration, plug_in.name, where)
    checks = list(check_class(kind, plug_in.name, load, lambda values: _params(kind, values), where))
    yield from checks
    broken = {check.name for check in checks if check.status != OK}
    if broken.isdisjoint({"parameters", "inputs"}):
        values = {} if "configuration" in broken else _configuration(plug_in.name, where, settings)
        if settings:
            _require_known(kind, values or {})
        yield from check_answers(lambda: kind(_params(kind, values or {})))


def _configuration(name: str, where: str, settings: Sequence[str] = ()) -> dict[str, Any] | None:
    """Returns what `lodbench run method=NAME` and some settings tell a method; None if no file does."""
    from hydra.errors import ConfigCompositionException, MissingConfigException
    from omegaconf import OmegaConf

    register_config_sources()
    words = [f"method={name}", *settings]
    try:
        config = composed("run", words).method
        return section({"method": OmegaConf.to_container(config, resolve=True)}, "method")
    except MissingConfigException:
        return None
    except ConfigCompositionException as error:
        raise explained(error, "run", words) from error
    except Exception as error:  # the YAML reader's faults share no base with Hydra's
        raise ConfigError(f"{where} cannot be read: {str(error).splitlines()[0]}") from error


def _require_known(kind: Any, values: Mapping[str, Any]) -> None:
    """Refuses wrong settings: they are no fault of the method, as which its answers would tell them."""
    try:
        _params(kind, values)
    except ConfigError:
        raise
    except STOPPED:
        raise
    except BaseException:  # a method may raise anything: reported with its answers
        return


def _params(kind: Any, values: Mapping[str, Any]) -> Any:
    return to_params(dict(values), kind.params_type, "method")
