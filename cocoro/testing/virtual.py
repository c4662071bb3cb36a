"""Tests that are coroutines, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, ParamSpec

from cocoro.vloop import run_virtual

P = ParamSpec("P")

LIMIT_S = 3600.0
"""Virtual seconds after which a test counts as stuck."""
_SETTLE_TURNS = 64


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """A test that is a coroutine. Its sleeps and time-outs take no time; fixtures work as in any other test."""

    @wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        run_virtual(asyncio.wait_for(test(*args, **kwargs), LIMIT_S))

    return run


async def settle() -> None:
    """Let everything that can happen now happen; no time passes."""
    for _ in range(_SETTLE_TURNS):
        await asyncio.sleep(0)
