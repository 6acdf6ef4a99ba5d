"""Methods by name: from an entry point and settings to a method, checked before any work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import LodbenchError
from lodbench.methods.protocol import Method, SupportsPriorWidth, SupportsTrueTilt
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin, of_kind
from lodbench.storage.paths import path_name

# What says more than a setting: what a method is called by, and what is remarked of it.
_NAMED_OTHERWISE = ("name", "variant", "notes", "matcher", "features")


@dataclass(frozen=True, slots=True)
class ConfiguredMethod:
    """A method's class and the parameters to make it from."""

    kind: Any  # the class
    params: Any  # of its ``params_type``

    def make(self) -> Method:
        """Returns the method, made anew.

        Raises:
            ConfigError: It cannot be made.
        """
        with blaming("methods", self.kind.name, "be made"):
            method: Method = self.kind(self.params)
            path_name("method", method.name)
        return method

    def for_prior(self, prior: UniformPrior) -> ConfiguredMethod:
        """Returns the same for how far off priors may be, if its method can be set to that."""
        method = self.make()
        if not isinstance(method, SupportsPriorWidth):
            return self
        with blaming("methods", self.kind.name, "take the width of priors"):
            params = of_kind(method.params_for_prior(prior), self.kind.params_type)
        return ConfiguredMethod(self.kind, params)

    def for_tilt(self, tilt: str) -> ConfiguredMethod:
        """Returns the same for priors of the true tilt, if the protocol's (``prior``, ``truth``) is that."""
        method = self.make()
        if tilt != "truth" or not isinstance(method, SupportsTrueTilt):
            return self
        with blaming("methods", self.kind.name, "take the true tilt"):
            params = of_kind(method.params_for_true_tilt(), self.kind.params_type)
        return ConfiguredMethod(self.kind, params)


def configure_method(settings: Mapping[str, Any], prefix: str = "method") -> ConfiguredMethod:
    """Returns the method that settings ask for: ``name``, and parameters that differ from its defaults.

    Faults name settings as ``PREFIX.NAME``.

    Raises:
        ConfigError: There is no such method, or a parameter is unknown or out of range.
    """
    name = str(settings.get("name", ""))
    kind = load_plugin("methods", name)
    with blaming("methods", name, "take its settings"):
        return ConfiguredMethod(kind, to_params(settings, kind.params_type, prefix))


def make_method(name: str, **params: Any) -> Method:
    """Returns a method by its name, with some parameters set.

    Raises:
        ConfigError: As for ``configure_method``.
    """
    return configure_method({"name": name, **params}).make()


def changed_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns those settings of a method that are not its defaults; none where it is not installed.

    Its ``name`` is among them; what its variant says (``variant``, ``matcher``, ``features``) and notes are
    left out.
    """
    try:
        params_type = load_plugin("methods", str(settings.get("name", ""))).params_type
    except LodbenchError:
        return {}
    defaults: dict[str, Any] = {}
    for field in fields(params_type):
        if field.default is not MISSING:
            defaults[field.name] = field.default
        elif field.default_factory is not MISSING:
            defaults[field.name] = field.default_factory()
    return {
        name: value
        for name, value in settings.items()
        if name not in _NAMED_OTHERWISE and (name not in defaults or _plain(defaults[name]) != _plain(value))
    }


def _plain(value: Any) -> Any:
    """Returns a setting as a configuration file has it."""
    return list(map(_plain, value)) if isinstance(value, tuple | list) else value
