"""A driver that hangs or crashes, played by processes that do."""

import subprocess
import sys
import time

import pytest
from hostile_scenes import box, scene_of

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.rendering import gl_guard, open_renderer


@pytest.fixture
def untried(monkeypatch):
    """A process that has not tried the driver yet; and a way to say what a trial does."""
    monkeypatch.setattr(gl_guard, "_is_tried", type(gl_guard._is_tried)())
    return lambda script: monkeypatch.setattr(gl_guard, "_TRIAL", (sys.executable, "-c", script))


def test_one_that_hangs_is_given_up(untried):
    untried("import time; time.sleep(60)")
    started = time.monotonic()
    with pytest.raises(RenderingError, match="no answer within 1 s") as caught:
        gl_guard.require_driver(1.0)
    assert time.monotonic() - started < 30
    assert "doctor" in caught.value.hint


def test_one_that_crashes_is_named_by_its_signal(untried):
    untried("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(RenderingError, match="SIGSEGV"):
        gl_guard.require_driver()


def test_one_that_fails_says_why(untried):
    untried("import sys; sys.exit('no EGL here')")
    with pytest.raises(RenderingError, match="cannot draw: no EGL here"):
        gl_guard.require_driver()


def test_one_that_draws_is_tried_once(untried):
    untried("")
    gl_guard.require_driver()
    untried("import sys; sys.exit('again')")
    gl_guard.require_driver()


def test_the_renderer_asks_before_it_draws(untried):
    pytest.importorskip("pyrender")
    untried("import sys; sys.exit('no EGL here')")
    renderer = open_renderer("pyrender", scene_of(box([-3, -3, 0], [6, 6, 9])))
    with pytest.raises(RenderingError, match="no EGL here"):
        renderer.render(Camera(16, 16, 8.0, 8.0, 8.0, 8.0), Pose.from_euler(EulerAngles(0, 0, 0), (0, 0, 40)))


@pytest.mark.slow
def test_a_draw_without_end_ends_the_process_with_the_reason():
    script = (
        "import time; from lodbench.rendering.gl_guard import Watch; watch = Watch(0.5, 0.1)\n"
        "for _ in range(3):\n"
        "    with watch.watching(): time.sleep(0.2)\n"
        "time.sleep(1)\n"
        "print('drawn', flush=True)\n"
        "with watch.watching(): time.sleep(60)\n"
        "print('never')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=50)
    assert done.returncode == 2
    assert done.stdout == "drawn\n"
    assert "has not answered for 0.5 s" in done.stderr
