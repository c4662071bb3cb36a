"""Removal of shared memory: none is left behind, and none that a process holds is removed."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest
from namespace_rig import Namespace, needs_root
from zenoh_rig import PATIENCE_S, PUBLISHER, held

from cocoro.bus import shared
from cocoro.bus.declared import SharedPool


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in /dev/shm's place."""
    monkeypatch.setattr(shared, "PLACE", tmp_path)
    return tmp_path


def segment(place: Path, name: str = "123.zenoh", size: int = 4096) -> Path:
    path = place / name
    path.write_bytes(bytes(size))
    return path


def test_what_nobody_holds_is_swept_and_nothing_else(place: Path) -> None:
    dead, live, newborn = (segment(place, f"{n}.zenoh") for n in (1, 2, 3))
    newborn.write_bytes(b"")
    others = [segment(place, name) for name in ("4.other", "x.zenoh", "sem.zenoh", "5.zenoh.bak")]
    (place / "6.zenoh").symlink_to(others[0])
    (place / "7.zenoh").mkdir()
    with live.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        assert shared.sweep() == 1
    assert not dead.exists()
    assert all(path.exists() for path in (live, newborn, *others))
    os.utime(newborn, (0, 0))
    assert shared.sweep() == 2
    assert sorted(path.name for path in place.iterdir()) == sorted(
        [*(path.name for path in others), "6.zenoh", "7.zenoh"]
    )


@needs_root
def test_another_user_s_are_not_swept_by_root_either(place: Path) -> None:
    theirs = segment(place)
    os.chown(theirs, 65534, 65534)
    assert shared.sweep() == 0
    assert shared.segments() == {}
    assert theirs.exists()


def test_a_process_gives_back_what_it_alone_holds(place: Path) -> None:
    alone, both = segment(place, "1.zenoh"), segment(place, "2.zenoh")
    with alone.open("rb") as ours, both.open("rb") as mine, both.open("rb") as theirs:
        for file in (ours, mine, theirs):
            fcntl.flock(file, fcntl.LOCK_SH)
        mine.close()
        assert shared.release() == 2  # what `theirs` holds is this process's, too
    assert list(place.iterdir()) == []


@pytest.mark.process
def test_what_another_process_holds_too_is_left_to_it(place: Path) -> None:
    both = segment(place)
    hold = "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_SH); print(flush=True); input()"
    with (
        subprocess.Popen(
            [sys.executable, "-c", hold, str(both)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other,
        both.open("rb") as ours,
    ):
        assert other.stdout is not None
        other.stdout.readline()
        fcntl.flock(ours, fcntl.LOCK_SH)
        assert shared.release() == 0
        assert shared.sweep() == 0
        assert both.exists()
        other.communicate(b"\n")
        assert shared.release() == 1


def test_a_pool_that_is_given_up_leaves_nothing(needs_pool: None) -> None:
    before = set(held())
    pool = SharedPool()
    assert not pool.trouble
    taken = {path for path in set(held()) - before if path.stat().st_size == shared.POOL_BYTES}
    assert len(taken) == 1
    del pool
    assert not any(path.exists() for path in taken)


@pytest.mark.process
@needs_root
@pytest.mark.zenoh
def test_a_live_process_s_segments_survive_the_sweep_of_what_a_killed_one_left(directory: Path) -> None:
    with Namespace({shared.PLACE: "size=64m"}) as namespace:

        def start(kind: str) -> subprocess.Popen[str]:
            command = [*namespace.prefix, sys.executable, "-c", PUBLISHER, str(directory / kind), kind]
            started = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            assert started.stdout is not None
            assert started.stdout.readline().startswith("took ")
            return started

        def there() -> set[str]:
            return {path.name for path in namespace.at(shared.PLACE).iterdir()}

        with start("publisher") as killed:
            left = there()
            with start("publisher") as live:
                theirs = there() - left
                assert len(left) == len(theirs) == 3
                killed.kill()
                killed.wait()
                assert theirs <= there() <= left | theirs  # zenoh removes what it shared with the dead one, and no more
                sweep = "from cocoro.bus import shared; print(shared.sweep())"
                while there() != theirs:  # the kernel lets go of a killed process's files a moment after its end
                    subprocess.run([*namespace.prefix, sys.executable, "-c", sweep], check=True, capture_output=True)
                    assert theirs <= there()
                assert there() == theirs
                live.communicate("\n", timeout=PATIENCE_S)
        assert there() == set()
