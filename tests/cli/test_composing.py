"""A single job's configuration is the one that Hydra's own entry composes."""

import sys

import hydra
import pytest

from lodbench.cli.hydra_app import plain, register_config_sources, single_job


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["method=region", "dataset=views", "dataset.city_model=a.obj", "seed=3", "split=[a,b]"],
        ["+note=${hydra:runtime.choices.method}", "++source.options.q=1", "tilt=truth"],
    ],
    ids=["as it stands", "choices", "what Hydra knows"],
)
def test_it_is_that_of_hydra_s_own_entry(monkeypatch, words):
    register_config_sources()
    expected = []
    monkeypatch.setattr(sys, "argv", ["lodbench run", *words])
    entry = hydra.main(config_path="pkg://lodbench.conf", config_name="run", version_base="1.3")
    entry(lambda config: expected.append(plain(config)))()
    assert plain(single_job("run", words)) == expected[0]
    assert not words or plain(single_job("run", [])) != expected[0]
