"""Who gets the processor first when there is too little of it: what may not lose a frame, then who only looks on.

Ordinary users may do all of this: nothing is raised above other programs. A thread's priority is that of the thread
that started it, so whoever yields keeps one thread from before, to start what must not yield: the threads of zenoh,
which are given little to do, but hold the writers' memory until they have done it.

Most systems share the processor out among sessions first, whatever their priority (sched_autogroup), and every service
of a stack has its own session: then these priorities order the threads of one service, and no service can take from
another what that needs below its equal share.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

T = TypeVar("T")

_SLICE_NS: Final = 300_000
"""What a service of the frames' path asks the scheduler for at a time: who asks for little is let in at once."""
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274}
"""The system call's number; the C library has no name for it."""
_ATTRIBUTES: Final = struct.Struct("IIQiIQQQ")
"""struct sched_attr: size, policy, flags, nice, priority, runtime (the slice), deadline, period."""

_prompt: list[ThreadPoolExecutor] = []
"""The thread from before this process began to yield, if it does."""


def settle(nice: int) -> None:
    """Set this thread's priority, and that of all threads it starts from now on.

    nice: 0 for the frames' path. A service that yields by more than that also interrupts nobody when it wakes
    (SCHED_BATCH).
    """
    before = os.getpriority(os.PRIO_PROCESS, 0)
    if nice > before and not _prompt:
        _prompt.append(ThreadPoolExecutor(1, thread_name_prefix="prompt"))
        promptly(int)  # its thread starts now
    nice = max(nice, before)
    os.setpriority(os.PRIO_PROCESS, 0, nice)
    if sys.platform != "linux":
        return
    if nice > 0:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    elif (number := _SCHED_SETATTR.get(platform.machine())) is not None:
        attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, _SLICE_NS, 0, 0)
        ctypes.CDLL(None).syscall(number, 0, attributes, 0)  # a kernel before 6.12 goes on as it was


def promptly(call: Callable[[], T]) -> T:
    """What ``call`` returns; the threads that it starts don't yield, even if this one does."""
    return _prompt[0].submit(call).result() if _prompt else call()
