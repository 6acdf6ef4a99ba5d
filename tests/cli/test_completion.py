"""Words complete themselves in real shells, and the answers behind them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("ru", ["run"]),
        ("run meth", ["method="]),
        ("run method=con", ["method=contour_alignment"]),
        ("run method=region method.fine_w", ["method.fine_width="]),
        ("run ci", ["city="]),
        ("generate-training-data look=v", ["look=varied"]),
        ("train schedule=p", ["schedule=paper"]),
        ("localize --cit", ["--city"]),
        ("dataset ch", ["check"]),
        ("dataset check --hea", ["--headers-only"]),
        ("leaderboard bu", ["build"]),
        ("leaderboard add --ma", ["--map"]),
        ("completion z", ["zsh"]),
        ("mask --export co", ["coco"]),
        ("nothing x", []),
        ("run seed=1", []),
    ],
)
def test_the_answers(lodbench, words, expected):
    assert lodbench("__complete", *words.split()).stdout.splitlines() == expected


@pytest.mark.parametrize("words", [["mask"], ["mask", "--mask"], ["localize", "a.jpg", "--city"]])
def test_nothing_stands_before_files(lodbench, words):
    assert lodbench("__complete", *words, "").stdout == ""


def in_shell(shell: str, script: str) -> list[str]:
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} on this machine")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [shell, "-c", script], capture_output=True, text=True, timeout=120, env={**os.environ, "PATH": path}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("lodbench local", ["localize"]),
        # Bash parts words at "=": what is offered is what stands behind it.
        ("lodbench run method=con", ["contour_alignment"]),
        ("lodbench run meth", ["method="]),
    ],
)
def test_in_bash(line, expected):
    script = f"""
        source <(lodbench completion bash)
        COMP_LINE={line!r} COMP_POINT={len(line)}
        _lodbench
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    assert in_shell("bash", script) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("lodbench local", ["localize"]),
        ("lodbench run method=con", ["method=contour_alignment"]),
        ("lodbench run meth", ["method="]),
    ],
)
def test_in_zsh(words, expected):
    # Outside of its editor zsh completes nothing: what the function offers is printed instead.
    script = f"""
        autoload -U compinit && compinit -D -u 2>/dev/null
        source <(lodbench completion zsh)
        compadd() {{ while [[ $1 != -- ]]; do shift; done; shift; print -l -- "$@" }}
        words=({words}) CURRENT={len(words.split())}
        _lodbench
    """
    assert in_shell("zsh", script) == expected
