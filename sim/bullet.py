"""PyBullet, imported without its banner; one client object for each world."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


@contextmanager
def _quiet() -> Iterator[None]:
    """Discard what Python or C code writes to file descriptors 1 and 2, so that no banner gets into JSON or logs."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    sys.stderr.flush()
    libc.fflush(None)
    try:
        saved = {fd: os.dup(fd) for fd in (1, 2)}
    except OSError:  # a service without standard streams has nothing to keep clean
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in saved:
            os.dup2(nowhere, fd)
        yield
    finally:
        sys.stderr.flush()
        libc.fflush(None)
        for fd, copy in saved.items():
            os.dup2(copy, fd)
            os.close(copy)
        os.close(nowhere)


with _quiet():
    import pybullet


class Bullet:
    """A PyBullet client without a window. Its attributes are the functions and constants of `pybullet`; the functions
    are bound to this client, so that several worlds can live in one process."""

    def __init__(self) -> None:
        self.client: int = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        value = getattr(pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self.client)
        self.__dict__[name] = value
        return value

    @staticmethod
    def raw(name: str) -> Callable[..., Any]:
        """A function of `pybullet` that is not bound to this client: `client` is its last argument."""
        function: Callable[..., Any] = getattr(pybullet, name)
        return function

    def close(self) -> None:
        """Free the world. May be called twice."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1
