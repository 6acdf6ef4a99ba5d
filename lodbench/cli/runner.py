"""``runner=``: the process a method runs in, and methods that only another Python has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from lodbench.checks import FAULT, OK, Check
from lodbench.cli.configs import config_files
from lodbench.cli.setting_words import settings_of
from lodbench.cli.source_profiles import option_pairs
from lodbench.errors import LodbenchError
from lodbench.harness.remote.method import HERE, SUBPROCESS, RemoteMethod, RunnerParams
from lodbench.harness.remote.process import RunnerFault
from lodbench.methods import Method
from lodbench.methods.registry import configure_method
from lodbench.params import to_params

_PREFIX = "runner."


def made_method(values: Mapping[str, Any], runner: RunnerParams, tilt: str) -> tuple[Method, dict[str, Any]]:
    """Returns the method of a configuration's section where it is to run, and its parameters.

    Raises:
        ConfigError: It is unknown, a setting is wrong, or the other Python cannot run it.
    """
    if runner.name == HERE:
        configured = configure_method(values).for_tilt(tilt)
        return configured.make(), asdict(configured.params)
    method = RemoteMethod(values, runner, tilt)
    return method, method.params


def offer_methods(argv: Sequence[str]) -> None:
    """Lets Hydra know methods that a command line names and only its ``runner.python`` has.

    Raises:
        ConfigError: That Python cannot be started, or does not know them either.
    """
    if SUBPROCESS not in "".join(argv) or {"-h", "--help"}.intersection(argv):
        return
    words = dict(word.split("=", 1) for word in settings_of("run", argv) if "=" in word)
    python = words.get(f"{_PREFIX}python")
    if words.get("runner") != SUBPROCESS or not python:
        return
    from hydra.core.config_store import ConfigStore

    for name in filter(None, words.get("method", "").split(",")):
        if name not in config_files("method"):
            method = RemoteMethod({"name": name}, RunnerParams(SUBPROCESS, python))
            method.close()
            ConfigStore.instance().store(group="method", name=name, node=method.params)


def remote_checks(name: str, words: Sequence[str]) -> Iterator[Check]:
    """Yields what there is to say of a method in another Python.

    Raises:
        ConfigError: That Python cannot be started or has no lodbench, or a setting is wrong.
    """
    from lodbench.methods.conformance import check_answers, trial_settings
    from lodbench.methods.conformance.rules import known_inputs

    told = {key: value for key, value in option_pairs(words).items() if key.startswith(_PREFIX)}
    runner = to_params(
        {"name": SUBPROCESS, **{key.removeprefix(_PREFIX): value for key, value in told.items()}},
        RunnerParams,
        "runner",
    )
    settings = {
        key.removeprefix("method."): value for key, value in option_pairs(words).items() if key not in told
    }

    def make() -> RemoteMethod:
        return RemoteMethod({"name": name, **settings}, runner)

    try:
        method = make()
    except LodbenchError as error:
        # Wrong words of the command are no fault of the method.
        if isinstance(error, RunnerFault) or error.message.startswith("method."):
            raise
        yield Check("plug-in", "entry point", FAULT, error.message, error.hint)
        return
    method.close()
    yield Check("plug-in", "entry point", OK, f"{name}, in {runner.python}")
    yield Check("plug-in", "inputs", OK, known_inputs(method))
    if method.trial_params is not None:
        settings |= method.trial_params
        yield trial_settings(method.params, method.trial_params)
    yield from check_answers(make)
