"""`lodbench check-method NAME`: does a method keep to the protocol?"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from functools import partial
from typing import Any

from lodbench.checks import FAULT, OK, Check
from lodbench.cli.composing import composed
from lodbench.cli.console import check_lines, plain_check, traceback_lines
from lodbench.cli.hydra_app import register_config_sources, section
from lodbench.cli.hydra_faults import explained
from lodbench.cli.parser import Parser
from lodbench.cli.runner import remote_checks
from lodbench.errors import STOPPED, ConfigError, LodbenchError
from lodbench.methods.conformance import check_answers, check_class
from lodbench.params import to_params
from lodbench.plugins import PlugIn, find_plugin
from lodbench.reporting.aligned_text import count_of

_EPILOG = """\
A method is an entry point under lodbench.methods, with conf/method/NAME.yaml: see CONTRIBUTING.md, "Add a
method". It localises three photos of seven blocks, with exact masks, several times.
Settings are those of a run: lodbench check-method lodlocv2 method.variant=no_refine
In another environment: lodbench check-method NAME runner.python=PATH
Exit code: 0 it conforms to the protocol, 1 it does not, 2 there is no such method or setting.
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no such method or setting.
    """
    parser = Parser(
        "lodbench check-method",
        "Check a method against the protocol: its class, its configuration, its answers.",
        _EPILOG,
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
            checks = list(_checks(find_plugin("methods", options.name), options.settings))
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


def _checks(plug_in: PlugIn, settings: Sequence[str]) -> Iterator[Check]:
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
    """Returns what `lodbench run method=NAME` and some settings tell a method; None if no file does.

    Raises:
        ConfigError: The file cannot be read, or has no such setting.
    """
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
