"""What works here: `lodbench doctor`; which plug-ins conform: `lodbench check-plugin`, `check-method`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lodbench.cli.parser import Parser, check_lines, plain_check, traceback_lines
from lodbench.cli.settings import read_config
from lodbench.errors import STOPPED, ConfigError, LodbenchError, nearest_names
from lodbench.findings import FAULT, OK, Check
from lodbench.params import flag, parsed, to_params, word
from lodbench.plugins import KINDS, PlugIn, config_files, find_plugin
from lodbench.reporting.aligned_text import count_of

_JSON = "one check per line, for machines"
_SOURCE = "source"
# Kinds that read files of a user's.
_OF_SAMPLES = ("city-reader", "pose-format")
_EPILOG = """\
docs/plugins.md has an example of each kind, and says what its check proves. Exit code: 0 it conforms to
the protocol, 1 it does not, 2 there is no such plug-in, setting or sample.
"""
_EPILOG_OF_METHODS = """\
A method is an entry point under lodbench.methods, with conf/method/NAME.yaml: see CONTRIBUTING.md, "Add a
method". It localises three photos of seven blocks, with exact masks, several times.
Settings are those of a run: lodbench check-method lodlocv2 method.variant=no_refine
In another environment: lodbench check-method NAME runner.python=PATH
Exit code: 0 it conforms to the protocol, 1 it does not, 2 there is no such method or setting.
"""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """What `lodbench doctor` is given."""

    json: bool = flag(False, _JSON)
    thorough: bool = flag(
        False,
        "compile a function, draw with each renderer, ask each network, load each plug-in as well (half a "
        "minute)",
    )


def main_doctor(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if the base install is broken."""
    parser = Parser(
        "lodbench doctor",
        description="Check this installation, and say what to install for optional features.",
    )
    options = parsed(parser, argv, DoctorOptions)
    from lodbench.harness.doctor import examine, is_base_broken

    checks = examine(options.thorough)
    if options.json:
        lines: Iterator[str] = (json.dumps(_values(check)) for check in checks)
    else:
        lines = _lines(checks, options.thorough)
    sys.stdout.write("".join(line + "\n" for line in lines))
    return 1 if is_base_broken(checks) else 0


def _values(check: Check) -> dict[str, Any]:
    """Returns a check as JSON values; a traceback only where there is one."""
    values = asdict(check)
    return values if values["traceback"] else {k: v for k, v in values.items() if k != "traceback"}


def _lines(checks: list[Check], is_thorough: bool) -> Iterator[str]:
    """Yields the report for people."""
    yield from check_lines(checks)
    faults = [check for check in checks if check.status != "ok"]
    broken = ", ".join(check.name for check in faults if check.is_base)
    optional = ", ".join(check.name for check in faults if not check.is_base)
    yield ""
    fine = "The base install works." if is_thorough else "The base install is complete; --thorough tries it."
    yield f"The base install is broken: {broken}." if broken else fine
    if optional:
        yield f"Optional, not ready: {optional}."


@dataclass(frozen=True, kw_only=True)
class PluginOptions:
    """What `lodbench check-plugin` is given."""

    kind: str = word(f"{', '.join(kind.label for kind in KINDS.values())} or {_SOURCE}", metavar="KIND")
    name: str = word("the name of its entry point", metavar="NAME")
    settings: tuple[str, ...] = word(
        "of a segmenter, dataset or prior, as of a run: segmenter.weights=FILE",
        (),
        nargs="*",
        metavar="KIND.KEY=VALUE",
    )
    sample: Path | None = flag(None, "of a city-reader or pose-format: a file to read", metavar="FILE")
    json: bool = flag(False, _JSON)


def main_plugin(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no such kind, plug-in, setting or sample.
    """
    parser = Parser("lodbench check-plugin", "Check a plug-in against the protocol of its kind.", _EPILOG)
    options = parsed(parser, argv, PluginOptions)
    _require_sample(options.kind, options.sample)
    if options.kind == "method":
        return main_method([options.name, *options.settings, *(["--json"] if options.json else [])])
    groups = {kind.label: group for group, kind in KINDS.items()}
    if options.kind not in (*groups, _SOURCE):
        raise ConfigError(
            f"There is no kind {options.kind!r}.", nearest_names(options.kind, [*groups, _SOURCE])
        )
    from lodbench.harness.conformance import CONFIGURED

    if options.settings and groups.get(options.kind) not in CONFIGURED:
        hint = f"Leave {options.settings[0]} out."
        raise ConfigError(f"A {options.kind} is checked without settings.", hint)
    # What the plug-in prints is no line of the report's.
    with redirect_stdout(sys.stderr):
        if options.kind == _SOURCE:
            checks = list(_source_checks(options.name))
        else:
            checks = list(_checks(groups[options.kind], options.name, options.settings, options.sample))
    return _report(options.name, checks, options.json)


def _report(name: str, checks: Sequence[Check], as_json: bool, counts_rules: bool = False) -> int:
    """Prints what was checked; returns the exit code."""
    faults = [check for check in checks if check.status != OK]
    if as_json:
        lines = [json.dumps(asdict(check)) for check in checks]
    else:
        rules = f"{count_of(len(faults), 'rules')} of " if counts_rules else ""
        verdict = f"violates {rules}the protocol" if faults else "conforms to the protocol"
        lines = [*check_lines([*map(plain_check, checks)]), "", *traceback_lines(faults)]
        lines.append(f"{name} {verdict}.")
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
    from lodbench.harness.conformance import CONFIGURED, check_plugin, require_settings

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
    from lodbench.cli.options import option_pairs

    for each in words:
        if not each.startswith(f"{section}."):
            raise ConfigError(f"{each} is not a setting of a {section}.", f"Write {section}.KEY=VALUE.")
    return option_pairs([each.removeprefix(f"{section}.") for each in words])


def _source_checks(name: str) -> Iterator[Check]:
    """Yields whether a profile can be read, its options are options, and its reader there is."""
    from lodbench.cli.options import load_profile

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


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """What `lodbench check-method` is given."""

    name: str = word("the method's name, as in method=NAME", metavar="NAME")
    settings: tuple[str, ...] = word(
        "settings of the method to try", (), nargs="*", metavar="method.KEY=VALUE"
    )
    json: bool = flag(False, _JSON)


OPTIONS = {"doctor": DoctorOptions, "check-plugin": PluginOptions, "check-method": MethodOptions}


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
    options = parsed(parser, argv, MethodOptions)
    for setting in options.settings:
        if not setting.startswith(("method.", "runner.")):
            raise ConfigError(f"{setting} is not a setting of a method.", "Write method.KEY=VALUE.")
    from lodbench.cli.run import remote_checks

    # What the method prints is no line of the report's.
    with redirect_stdout(sys.stderr):
        if any(setting.startswith("runner.") for setting in options.settings):
            checks = list(remote_checks(options.name, options.settings))
        else:
            checks = list(_method_checks(find_plugin("methods", options.name), options.settings))
    return _report(options.name, checks, options.json, counts_rules=True)


def _method_checks(plug_in: PlugIn, settings: Sequence[str]) -> Iterator[Check]:
    from lodbench.harness.conformance.methods import check_answers, check_class

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

    from lodbench.cli.hydra_app import composed, explained, register_config_sources, section

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
