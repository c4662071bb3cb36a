"""One zenoh client with given credentials that does what it is told: `python -m bench.intruder CREDENTIALS ENDPOINT`.

It asks nobody whether it may: it sends raw samples, queries and declarations, as somebody does who has stolen a
certificate and writes his own program. A line of JSON on standard input is an attempt, a line on standard output says
what came of it; `Intruder` is the other end. The first line says whether it was let in.

put      key, payload        a sample
flood    keys, bytes, count, hz    `count` samples of `bytes` bytes, to the keys in turn
ask      key, payload        a query to all servers; the answers
asks     key, payload, count        `count` queries at once; how many were answered
serve    key, payload        a queryable that answers with this
show     key                 a liveliness token
hear     key                 a subscriber; `heard` says what came, as [key, payload]
watch    key                 as `hear`, for liveliness tokens
end      key                 undeclares all
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zenoh

from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.register import new_identity
from cocoro.bus.session import options
from deploy.site.credentials import TLS
from deploy.site.place import CA_CERT, CERT, KEY
from sim.network.network import Host

PATIENCE_S = 20.0
"""Longest wait for the session, on a busy machine."""
ANSWER_S = 2.0
"""Longest wait for an answer to a query."""
SHOWN_BYTES = 4096
RANDOM = "random"
"""As a payload: random bytes, others each time."""
NOTHING = "-"
"""In place of a folder: no certificate."""
QOS: dict[str, Any] = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.BLOCK}


class Intruder:
    """The process, and the way to it. `refused` is the reason for which it was not let in, '' when it was."""

    def __init__(
        self,
        host: Host,
        credentials: Path | None,
        endpoint: str,
        ca: Path | None = None,
        more: Mapping[str, Any] | None = None,
        *,
        yields: bool = False,
    ) -> None:
        """`ca`: the authority that it trusts, without or instead of that of its credentials; `more`: zenoh's options,
        by path. `yields`: it takes only the processor time that the robot leaves, as it is on another machine in truth.
        """
        argv = [sys.executable, "-m", "bench.intruder", credentials or NOTHING, endpoint, ca or NOTHING]
        argv.append(json.dumps(more or {}))
        self._process = host.run(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        if yields:
            os.sched_setscheduler(self._process.pid, os.SCHED_IDLE, os.sched_param(0))
        self._lock = threading.Lock()
        self.refused: str = self._read()

    def __call__(self, do: str, **given: Any) -> Any:
        """Does one thing, and waits for what comes of it."""
        with self._lock:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps({"do": do, **given}) + "\n")
            self._process.stdin.flush()
            return self._read()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the intruder has ended with {self._process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Intruder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Client:
    """What the process does."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[Any] = []
        self._heard: list[tuple[str, str]] = []
        self.does: Mapping[str, Callable[..., Any]] = {
            "put": self.put, "flood": self.flood, "ask": self.ask, "asks": self.asks, "serve": self.serve,
            "show": self.show, "hear": self.hear, "heard": self.heard, "watch": self.watch, "end": self.end,
        }  # fmt: skip

    def put(self, key: str, payload: str) -> None:
        self._session.put(key, _bytes(payload), **QOS)

    def flood(self, keys: list[str], bytes: int, count: int, hz: float = 0.0, payload: str = "") -> float:
        """Returns how many it sent in a second. It waits where its link does not take more."""
        content = None
        if payload not in ("", RANDOM):
            content = zenoh.ZBytes(
                _bytes(payload) * (bytes // max(len(payload), 1))
            )  # held once, however many are sent
        begun_s = time.monotonic()
        for number in range(count):
            if hz and (ahead_s := begun_s + number / hz - time.monotonic()) > 0:
                time.sleep(ahead_s)
            key = keys[number % len(keys)]
            self._session.put(key, content or random.randbytes(bytes), **QOS)
        return count / max(time.monotonic() - begun_s, 1e-9)

    def ask(self, key: str, payload: str, wait_s: float = ANSWER_S) -> list[str]:
        found = []
        for reply in self._session.get(
            key, payload=_bytes(payload), timeout=wait_s, target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE, **QOS,
        ):  # fmt: skip
            answer = reply.ok or reply.err
            assert answer is not None
            found.append(answer.payload.to_bytes()[:SHOWN_BYTES].decode(errors="replace"))
        return found

    def asks(self, key: str, payload: str, count: int) -> int:
        """As `flood`, with queries that do not wait for one another. Returns how many were answered."""
        ends = [self._session.get(key, payload=_bytes(payload), timeout=ANSWER_S, **QOS) for _ in range(count)]
        return sum(any(reply.ok or reply.err for reply in end) for end in ends)

    def serve(self, key: str, payload: str) -> None:
        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr if "*" not in str(query.key_expr) else key, _bytes(payload))

        self._declared.append(self._session.declare_queryable(key, answer))

    def show(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def hear(self, key: str) -> None:
        self._declared.append(self._session.declare_subscriber(key, self._on_sample))

    def watch(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_subscriber(key, self._on_sample, history=True))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._heard.append((str(sample.key_expr), sample.payload.to_bytes()[:SHOWN_BYTES].hex()))

    def heard(self) -> list[tuple[str, str]]:
        found, self._heard = self._heard, []
        return found

    def end(self) -> None:
        for one in self._declared:
            one.undeclare()
        self._declared.clear()


def _bytes(payload: str) -> bytes:
    if payload == RANDOM:
        return random.randbytes(random.randrange(1, 2000))
    return bytes.fromhex(payload[2:]) if payload.startswith("0x") else payload.encode()


def open_client(folder: str, endpoint: str, ca: str, more: Mapping[str, Any]) -> zenoh.Session:
    config = ZenohConfig("intruder", mode="client", connect=(endpoint,), patience_s=PATIENCE_S)
    chosen = options(config, new_identity(), [], [endpoint])
    if folder != NOTHING:
        chosen |= {
            f"{TLS}/enable_mtls": True,
            f"{TLS}/connect_private_key": f"{folder}/{KEY}",
            f"{TLS}/connect_certificate": f"{folder}/{CERT}",
            f"{TLS}/root_ca_certificate": f"{folder}/{CA_CERT}",
        }
    if ca != NOTHING:
        chosen[f"{TLS}/root_ca_certificate"] = ca
    settings = zenoh.Config()
    for path, value in {**chosen, **more}.items():
        settings.insert_json5(path, json.dumps(value))
    return zenoh.open(settings)


def main(folder: str, endpoint: str, ca: str, more: str) -> None:
    try:
        session = open_client(folder, endpoint, ca, json.loads(more))
    except zenoh.ZError as error:
        print(json.dumps(str(error) or "refused"), flush=True)
        return
    client = Client(session)
    print(json.dumps(""), flush=True)
    for line in sys.stdin:
        given = json.loads(line)
        print(json.dumps(client.does[given.pop("do")](**given)), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
