"""A child process that answers over pipes, and may hang, die or write nonsense."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from lodbench.errors import ConfigError, LodbenchError, WorkersGone
from lodbench.harness.remote.wire import MalformedMessage, fault_told, numbered, packed, unpacked

# Of what the child wrote to standard error, at most this much is reported.
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
        # Messages that were sent, and the end of what the child wrote to standard error.
        self._number, self._errors = 0, b""
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the Python that the user names
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
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
        assert self._process.stderr is not None  # noqa: S101
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()
        self._err = self._process.stderr.fileno()
        self._err_is_open = True
        for stream in (self._in, self._out, self._err):
            os.set_blocking(stream, False)

    def call(self, message: dict[str, Any], answer: Callable[[list[Any]], Any], timeout_s: float) -> Any:
        """Returns the child's last word to a message.

        A child whose messages have other numbers than they should, or that says something before it is asked
        (two processes write, where a method forked), is stopped: its answer would be to another message.

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
            self._send(message, deadline)
            while True:
                said = numbered(unpacked(lambda count: self._read(count, deadline)), self._number)
                if "ask" not in said:
                    return said
                try:
                    reply = {"answer": answer(list(said["ask"]))}
                except WorkersGone:
                    # The run ends, and no query fails: nothing to tell the child.
                    self.close()
                    raise
                except LodbenchError as fault:
                    reply = fault_told(fault)
                except Exception as error:  # it may ask with arguments of any kind
                    reply = {
                        "fault": f"{type(error).__name__}: {error}",
                        "hint": "",
                        "kind": "RenderingError",
                    }
                self._send(reply, deadline)
        except (TimeoutError, EOFError, OSError, MalformedMessage) as error:
            raise self._fault(error, timeout_s) from None

    def close(self) -> None:
        """Ends the process and whatever it started."""
        # Before it is waited for: until then nobody else can have its number.
        if self._process.returncode is None:
            self._kill_group()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()

    def _send(self, message: dict[str, Any], deadline: float) -> None:
        """Sends a message with the next number."""
        if self._has_said():
            raise MalformedMessage("bytes that nobody had requested")
        self._number += 1
        self._write(packed({"number": self._number, **message}), deadline)

    def _has_said(self) -> bool:
        """Tells whether bytes wait that were not requested."""
        if not select.select([self._out], [], [], 0)[0]:
            return False
        if not os.read(self._out, 1):
            raise EOFError
        return True

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

    def _wait(self, reading: list[int], writing: list[int], deadline: float) -> None:
        """Returns when one of the pipes is ready; meanwhile takes what comes on standard error."""
        while (left := deadline - time.monotonic()) > 0:
            errors = [self._err] if self._err_is_open else []
            ready, writable, _ = select.select([*reading, *errors], writing, [], left)
            if self._err in ready:
                self._take_errors()
            if writable or set(ready) & set(reading):
                return
        raise TimeoutError

    def _take_errors(self) -> None:
        """Takes what is there of the child's standard error and keeps the end: it may write any amount."""
        # Once around what a pipe holds: a child that never stops must not keep this from its deadline.
        for _ in range(16):
            try:
                part = os.read(self._err, _CHUNK)
            except BlockingIOError:
                return
            if not part:
                self._err_is_open = False
                return
            self._errors = (self._errors + part)[-_TAIL_BYTES:]

    def _fault(self, error: Exception, timeout_s: float) -> ProcessFault:
        """Stops the child; returns why it gave no answer."""
        if isinstance(error, TimeoutError):
            reason = f"the method's process gave no answer in {timeout_s:g} s and was stopped"
        elif isinstance(error, MalformedMessage):
            reason = f"the method's process was stopped, for {error.message}"
        else:
            reason = f"the method's process ended with exit code {self._exit_code()}"
        if self._err_is_open:
            self._take_errors()
        errors = self._errors.decode(errors="replace").strip()
        self.close()
        last = errors.splitlines()[-1].strip() if errors else ""
        fault = ProcessFault(f"{reason}: {last}" if last else reason)
        if errors:
            fault.add_note(f"Its standard error:\n{errors}")
        return fault

    def _exit_code(self) -> int | None:
        """Returns the code of a process that closed its pipe, or None where it does not end."""
        for _ in range(_LAST_WAITS):
            if self._err_is_open:
                self._take_errors()  # else it may wait for room, and not end
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
