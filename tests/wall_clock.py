"""A wall clock that a test steps in the processes that it starts, without changing the machine's.

A few lines of C are compiled and preloaded (LD_PRELOAD), so that the C library returns a stepped wall time to Python
and to libraries such as zenoh. Steady clocks are unchanged. Wall time inside the kernel (timers on CLOCK_REALTIME, file
times) is not stepped.
"""

from __future__ import annotations

import mmap
import os
import shutil
import struct
import subprocess
from pathlib import Path
from types import TracebackType

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long long step_ns(void) {
    static volatile const long long *step;
    if (!step) {
        const char *file = getenv("WALL_STEP");
        int fd = file ? open(file, O_RDONLY | O_CLOEXEC) : -1;
        if (fd < 0) return 0;
        void *at = mmap(0, sizeof *step, PROT_READ, MAP_SHARED, fd, 0);
        close(fd);
        if (at == MAP_FAILED) return 0;
        step = at;
    }
    return *step;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *)) dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(clock, now);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        long long ns = now->tv_sec * 1000000000LL + now->tv_nsec + step_ns();
        now->tv_sec = ns / 1000000000LL;
        now->tv_nsec = ns % 1000000000LL;
    }
    return failed;
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec spec;
    (void) zone;
    int failed = clock_gettime(CLOCK_REALTIME, &spec);
    if (!failed) { now->tv_sec = spec.tv_sec; now->tv_usec = spec.tv_nsec / 1000; }
    return failed;
}

time_t time(time_t *now) {
    struct timespec spec;
    clock_gettime(CLOCK_REALTIME, &spec);
    if (now) *now = spec.tv_sec;
    return spec.tv_sec;
}
"""


class NoPreloadError(Exception):
    """The wall clock cannot be stepped here; the text gives the reason."""


class WallClock:
    """Steps the wall time of all processes that are started with `env`. A context manager."""

    def __init__(self, folder: Path) -> None:
        """Raises NoPreloadError."""
        compiler = shutil.which("cc")
        if compiler is None:
            raise NoPreloadError("no C compiler (cc) to make the stepped clock with")
        source, library, self._file = folder / "wall.c", folder / "wall.so", folder / "wall.step"
        source.write_text(SOURCE)
        made = subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"],
            capture_output=True,
            text=True,
        )
        if made.returncode:
            raise NoPreloadError(f"the stepped clock cannot be compiled: {made.stderr[-300:]}")
        self._file.write_bytes(bytes(8))
        self.env = {"LD_PRELOAD": str(library), "WALL_STEP": str(self._file)}

    def __enter__(self) -> WallClock:
        self._fd = os.open(self._file, os.O_RDWR)
        self._memory = mmap.mmap(self._fd, 8)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._memory.close()
        os.close(self._fd)

    def step_to(self, seconds: float) -> None:
        """Set the wall time to the machine's plus an offset, s."""
        self._memory[:8] = struct.pack("=q", round(seconds * 1e9))
