"""Kills a process in the middle of its work."""

import os
import signal


def in_child(work):
    """Whether a child process does its work to the end."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitpid(child, 0)[1] == 0


def die_at(call, *targets):
    """Kills this process at one of all calls of some functions, each given as (owner, name), counted from 0."""
    calls = iter(range(10**6))

    def counted(function):
        def run(*arguments, **more):
            if next(calls) == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **more)

        return run

    for owner, name in targets:
        setattr(owner, name, counted(getattr(owner, name)))
