"""What a rehearsal needs and takes long to make, begun beside the imports of the rest.

Of two cores one would wait meanwhile. Import NumPy with `OPENBLAS_NUM_THREADS` set to 1 before: a process with threads
cannot fork its camera's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread

import sim.camera  # noqa: F401 # what both processes need is imported once
from services.perception.cielab import prepare
from sim.camera_process.start import started_ahead


@contextmanager
def begun_ahead() -> Iterator[None]:
    """Start the camera's process and, in a thread, what converting colours needs. The process ends with the context if
    no rehearsal took it."""
    with started_ahead():  # before the thread, since it forks
        Thread(target=prepare, name="colours", daemon=True).start()
        yield
