"""A zenoh session on a host of an emulated network, for `bench/network.py` and tests.

`python -m bench.network_speaker router|client ENDPOINT LEASE_S LIFE_S`. The router listens and puts a message with a
number on `tick`, at most fifty times a second. The client subscribes to it and prints the time of the steady clock and
the number; for each line of its standard input it asks the router's `echo`, again until a reply comes, and prints that:
a session that has just begun may not know yet who answers. Both have the project's options of a session, print `ready`
first, and end after LIFE_S.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from itertools import count
from typing import Any

import zenoh

from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.session import open_session, options
from sim.network.network import Host

PERIOD_S = 0.02
PATIENCE_S = 60.0
ANSWER_S = 5.0
"""Longest wait for one answer, with the retries of a cut and lossy link."""
_SAYING = threading.Lock()
IDENTITIES = {"router": "a1", "client": "b2"}


def say(*words: object) -> None:
    """Prints a line whole: messages are printed by a thread of zenoh, and `print` writes word by word."""
    with _SAYING:
        print(*words, flush=True)


def opened(mode: str, endpoint: str, lease_s: float) -> zenoh.Session:
    if mode == "router":
        config = ZenohConfig("router", mode="router", listen=(endpoint,), lease_s=lease_s)
    else:
        config = ZenohConfig("client", mode="client", connect=(endpoint,), lease_s=lease_s, patience_s=PATIENCE_S)
    chosen = options(config, IDENTITIES[mode], [*config.listen], [*config.connect])
    return open_session(config, chosen).session


def route(session: zenoh.Session) -> None:
    session.declare_queryable("echo", lambda query: query.reply("echo", str(query.parameters)))
    say("ready")
    for number in count():
        session.put("tick", str(number))
        time.sleep(PERIOD_S)


def listen(session: zenoh.Session) -> None:
    session.declare_subscriber("tick", lambda tick: say(time.monotonic(), tick.payload.to_string()))
    say("ready")
    for line in sys.stdin:
        while not (replies := list(session.get(f"echo?{line.strip()}", timeout=ANSWER_S))):
            time.sleep(PERIOD_S)
        for reply in replies:
            say("reply", reply.ok.payload.to_string() if reply.ok else "")


class Speaker:
    """The process of a speaker, from outside."""

    def __init__(self, host: Host, mode: str, endpoint: str, lease_s: float = 4.0, life_s: int = 300) -> None:
        """Starts it and waits until it is ready; it is ended with the network. Who waits for a speaker fails when
        its life is over."""
        argv = [sys.executable, "-m", "bench.network_speaker", mode, endpoint, str(lease_s), str(life_s)]
        self._process: subprocess.Popen[Any] = host.run(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        self._line("ready")

    def _line(self, *first: str) -> list[str]:
        """The words of the next line that begins with one of `first`, or with a number where none is given."""
        for line in self._output:
            words: list[str] = line.split()
            if words[0] in first or (not first and words[0][0].isdigit()):
                return words
        raise RuntimeError("the speaker has ended")

    def tick(self) -> tuple[float, int]:
        """When the client printed the next message, s, and its number. Waits for it."""
        when, number = self._line()
        return float(when), int(number)

    def tick_from(self, number: int) -> int:
        """The first message whose number is at least `number`."""
        while (found := self.tick()[1]) < number:
            pass
        return found

    def heard_after(self, when_s: float) -> float:
        """When the client printed its first message later than `when_s`."""
        while (found_s := self.tick()[0]) <= when_s:
            pass
        return found_s

    def ask(self, word: str) -> str:
        """The router's answer, by the client."""
        self._input.write(f"{word}\n")
        return self._line("reply")[1]


if __name__ == "__main__":
    mode, endpoint, lease_s, life_s = sys.argv[1:]
    signal.alarm(int(life_s))
    with opened(mode, endpoint, float(lease_s)) as session:
        (route if mode == "router" else listen)(session)
