"""Exports of a capture: size and processor time of each form, and whether `view` ends where nobody can see it.

    python -m bench.exports sizes [FILE]     # without FILE, of two rehearsed fetches
    python -m bench.exports viewer FILE      # needs the extra `view`

`viewer` starts `cocoro view` without a display, with a display that is not there, with nobody at the other end, with
somebody who takes nothing, and as a page, and prints how each ended and after how long.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COCORO = [sys.executable, "-m", "apps.cli.main"]
FORMS = {
    "--foxglove": "fox.mcap",
    "--rrd": "out.rrd",
    "--video": "robot.mp4",
    "--video --camera both": "both.mp4",
    "--video --camera outside": "outside.webp",
    "--csv": "csv",
}
FETCHES = {
    "320x240 at 15 Hz": ["--frames", "320x240@15"],
    "640x480 at 30 Hz, real sensors": ["--sensors", "real"],
}
ENDS_S = 60.0
"""A command that has not ended by then hangs."""


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def size_of(path: Path) -> int:
    return path.stat().st_size if path.is_file() else sum(part.stat().st_size for part in path.rglob("*"))


def sizes(file: Path, folder: Path) -> None:
    whole = size_of(file)
    print(f"{file.name}: {whole / 1e6:.2f} MB")
    for form, name in FORMS.items():
        out = folder / name
        option, *more = form.split()
        before_s = cpu_s()
        done = subprocess.run([*COCORO, "export", str(file), option, str(out), *more], capture_output=True, text=True)
        used_s = cpu_s() - before_s
        if done.returncode != 0:
            print(f"  {form:<26} {done.stderr.strip()}")
            continue
        print(f"  {form:<26} {size_of(out) / 1e6:8.2f} MB  {size_of(out) / whole:6.2f} of it  {used_s:6.1f} s of CPU")


def rehearsed(options: list[str], out: Path) -> Path:
    command = [*COCORO, "rehearse", "fetch", "red_can", "--seed", "3", *options, "--record", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return out


def ended(words: list[str], env: dict[str, str] | None = None, interrupt_at: str = "") -> str:
    """Run `cocoro view` and describe its end. With `interrupt_at` Ctrl-C follows these words of it."""
    started_s = time.monotonic()
    process = subprocess.Popen(
        [*COCORO, "view", *words], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    heard = ""
    if interrupt_at and process.stdout is not None:
        for line in process.stdout:
            heard += line
            if interrupt_at in line:
                heard += listeners(heard)
                process.send_signal(signal.SIGINT)
                break
    try:
        out, err = process.communicate(timeout=ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return f"HANGS: no end within {ENDS_S:.0f} s"
    words_heard = " / ".join((heard + out + err).split("\n")).strip(" /")
    return f"exit code {process.returncode} after {time.monotonic() - started_s:.1f} s: {words_heard}"


def listeners(heard: str) -> str:
    """The addresses on which the page and its data are served."""
    ports = re.findall(r":(\d+)|%3A(\d+)%2Fproxy", heard)
    numbers = {f"{int(port):04X}" for pair in ports for port in pair if port}
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for row in Path(table).read_text().splitlines()[1:]:
            address, port = row.split()[1].split(":")
            if port in numbers and row.split()[3] == "0A":
                found.add("loopback" if address == "0100007F" else f"address {address}")
    return f"served on {', '.join(sorted(found)) or 'nothing'}\n"


def viewer(file: Path, folder: Path) -> None:
    bare = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    print("no display:          ", ended([str(file)], bare))
    print("a display that is not:", ended([str(file)], {**bare, "DISPLAY": ":77"}))
    print("nobody there:        ", ended([str(file), "--connect", "127.0.0.1:1"], bare))
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        print("takes nothing:       ", ended([str(file), "--connect", f"127.0.0.1:{port}"], bare))
    print("a file:              ", ended([str(file), "--save", str(folder / "view.rrd")], bare))
    print("a page:              ", ended([str(file), "--web"], bare, "Ctrl-C"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["sizes", "viewer"])
    parser.add_argument("file", nargs="?", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if chosen.what == "viewer":
            if chosen.file is None:
                parser.error("viewer needs a FILE")
            viewer(chosen.file, folder)
        elif chosen.file is not None:
            sizes(chosen.file, folder)
        else:
            for number, (name, options) in enumerate(FETCHES.items()):
                print(name)
                part = folder / str(number)
                part.mkdir()
                sizes(rehearsed(options, part / "fetch.mcap"), part)


if __name__ == "__main__":
    main()
