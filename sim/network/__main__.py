"""Makes a network of hosts on this machine, for first steps with several: `sudo python -m sim.network base brain`.

It prints for each host a command that runs another command there. Lines of the standard input change the network
meanwhile: `cut base`, `heal`, `set base brain delay_ms=20 loss=0.01`, `counts`. Its end (Ctrl-D, Ctrl-C) ends all that
runs on the hosts.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from cocoro.errors import CocoroError
from sim.network.network import Host, Network

HELP = "cut [HOST ...] | heal [HOST ...] | set [HOST HOST] NAME=VALUE ... | counts [HOST HOST]"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.network", description="Hosts with a network between them.")
    parser.add_argument("hosts", nargs="+", help="names; the first has the address 10.77.0.1")
    parser.add_argument("--mtu", type=int, default=1500, metavar="BYTES", help="of the largest packet (1500)")
    parser.add_argument("--seed", type=int, default=0, help="which packets are lost, and the jitter (0)")
    options = parser.parse_args()
    try:
        with Network(*options.hosts, mtu=options.mtu, seed=options.seed) as network:
            for name in options.hosts:
                host = network.host(name)
                print(f"{name:<12} {host.address:<12} {command_of(host)} COMMAND ...")
            print(f"Here: {HELP}", flush=True)
            for line in sys.stdin:
                try:
                    if said := obey(network, line.split()):
                        print(said, flush=True)
                except (ValueError, KeyError) as error:
                    print(error.args[0], flush=True)
    except (CocoroError, ValueError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        pass
    return 0


def command_of(host: Host) -> Path:
    """A file that runs its arguments on the host, in the folder where it is called."""
    path = host.folder / "on"
    path.write_text(f'#!/bin/sh\nexec {shlex.join(host.prefix)} "$@"\n')
    path.chmod(0o700)
    return path


def obey(network: Network, words: list[str]) -> str:
    """Carry out a line; returns what is to be said. Raises ValueError, KeyError for one that means nothing."""
    verb, *rest = words or [""]
    names = [word for word in rest if "=" not in word]
    link = network.link(*names) if len(names) == 2 else network.links(*names)
    if verb == "cut":
        network.cut(*names)
    elif verb == "heal":
        network.heal(*names)
    elif verb == "set":
        link.set(**dict(_setting(word) for word in rest if "=" in word))
    elif verb == "counts":
        return ", ".join(f"{count} {name}" for name, count in link.counts()._asdict().items())
    elif verb:
        raise ValueError(f"no {verb!r}: {HELP}")
    return ""


def _setting(word: str) -> tuple[str, Any]:
    name, _, text = word.partition("=")
    try:
        return name, json.loads(text)
    except ValueError:
        return name, text


if __name__ == "__main__":
    sys.exit(main())
