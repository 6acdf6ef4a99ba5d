"""A child process that is asked over pipes, and may hang, die or write nonsense."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from lodbench.errors import ConfigError, LodbenchError, WorkersGone
from lodbench.harness.remote.wire import MalformedMessage, fault_told, packed, unpacked

# Of what the child wrote to standard error, at most this much is told.
_TAIL_BYTES = 4000
# Bytes read and written at a time.
_CHUNK = 1 << 16
# How often, and how long each time, to wait for the end of a child that closed its pipe: seconds.
_LAST_WAITS, _WAIT_S = 250, 0.02


class RunnerFault(ConfigError):
    """``runner.python`` is no Python that can run the method."""


class ProcessFault(Exception):
    """The child died, took too long or wrote no message; its standard error is a note of this exception."""


class Child:
    """A process of another Python, asked one thing at a time; it and all it starts are one process group.

    Raises:
        RunnerFault: It cannot be started.
    """

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self._errors = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the Python that the user names
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=environment,
                bufsize=0,
                process_group=0,
            )
        except OSError as error:
            raise RunnerFault(
                f"{command[0]} cannot be started: {error.strerror}.", "runner.python=PATH names a Python."
            ) from error
        assert self._process.stdin is not None  # noqa: S101
        assert self._process.stdout is not None  # noqa: S101
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._in, False)
        os.set_blocking(self._out, False)

    def call(self, message: Any, answer: Callable[[list[Any]], Any], timeout_s: float) -> Any:
        """Returns the child's last word to a message.

        Args:
            message: What it is to do.
            answer: Answers what it asks meanwhile; what it raises goes to the child.
            timeout_s: Longest time for it, with all that is asked back meanwhile.

        Raises:
            ProcessFault: There is no answer; the child has been stopped.
            WorkersGone: So it was said where it asked; the child has been stopped.
        """
        deadline = time.monotonic() + timeout_s
        try:
            self._write(packed(message), deadline)
            while True:
                said = unpacked(lambda count: self._read(count, deadline))
                if not isinstance(said, dict):
                    raise MalformedMessage("a message is no word")
                if "ask" not in said:
                    return said
                try:
                    told = {"answer": answer(list(said["ask"]))}
                except WorkersGone:
                    # The run ends, and no query fails: nothing to tell the child.
                    self.close()
                    raise
                except LodbenchError as fault:
                    told = fault_told(fault)
                except Exception as error:  # it may ask with arguments of any kind
                    told = {"fault": f"{type(error).__name__}: {error}", "hint": "", "kind": "RenderingError"}
                self._write(packed(told), deadline)
        except (TimeoutError, EOFError, OSError, MalformedMessage) as error:
            raise self._fault(error, timeout_s) from None

    def close(self) -> None:
        """Ends the process and whatever it started."""
        # Before it is waited for: until then nobody else can have its number.
        if self._process.returncode is None:
            self._kill_group()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def _read(self, count: int, deadline: float) -> bytes:
        parts, missing = [], count
        while missing:
            self._wait([self._out], [], deadline)
            # Room is made for what came, not for what is said to come.
            part = os.read(self._out, min(missing, _CHUNK))
            if not part:
                raise EOFError
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)

    def _write(self, content: bytes, deadline: float) -> None:
        view = memoryview(content)
        while view:
            self._wait([], [self._in], deadline)
            view = view[os.write(self._in, view[:_CHUNK]) :]

    @staticmethod
    def _wait(reading: list[int], writing: list[int], deadline: float) -> None:
        left = deadline - time.monotonic()
        if left <= 0 or not any(select.select(reading, writing, [], left)):
            raise TimeoutError

    def _fault(self, error: Exception, timeout_s: float) -> ProcessFault:
        """Stops the child; returns why it gave no answer."""
        if isinstance(error, TimeoutError):
            reason = f"the method's process gave no answer in {timeout_s:g} s and was stopped"
        elif isinstance(error, MalformedMessage):
            reason = f"the method's process was stopped, for {error.message}"
        else:
            reason = f"the method's process ended with exit code {self._exit_code()}"
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, self._errors.tell() - _TAIL_BYTES))
        errors = self._errors.read().decode(errors="replace").strip()
        self.close()
        last = errors.splitlines()[-1].strip() if errors else ""
        fault = ProcessFault(f"{reason}: {last}" if last else reason)
        if errors:
            fault.add_note(f"Its standard error:\n{errors}")
        return fault

    def _exit_code(self) -> int | None:
        """Returns the code of a process that closed its pipe, or None where it does not end."""
        for _ in range(_LAST_WAITS):
            if (code := self._ended_with()) is not None:
                return code
            time.sleep(_WAIT_S)
        return None

    def _ended_with(self) -> int | None:
        """Returns the code of the process if it has ended, without taking it off the list of processes."""
        if not hasattr(os, "waitid"):
            # macOS before Python 3.13: it is off the list then, so what it started ends at once.
            if self._process.poll() is not None:
                self._kill_group()
            return self._process.returncode
        ended = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
        if ended is None:
            return None
        return ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status

    def _kill_group(self) -> None:
        # macOS answers "not permitted" for a group of processes that have all ended.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
