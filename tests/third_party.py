"""A third party's distribution, installed by pip without network: the template of `cocoro new service`, with a second
topic that is not recorded."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from apps.cli.main import main
from cocoro.capture import types
from cocoro.entry_points import added_to
from cocoro.installed import third_parties
from deploy import processes

NAME = "odometer"
SCRATCH = f'''

SCRATCH = Topic(
    "{NAME}/scratch",
    Travelled,
    Qos.STATE,
    rate_hz=2.0,
    max_age_s=2.0,
    doc="Private.",
    recorded=False,
)
'''


def forget_third_parties() -> None:
    """Have installed components looked for anew."""
    processes.table.cache_clear()
    third_parties.cache_clear()
    added_to.cache_clear()
    types.reader_of.cache_clear()


def install(folder: Path) -> Path:
    """Write the distribution and install it; returns the directory that `sys.path` needs."""
    assert main(["new", "service", NAME, "--into", str(folder)]) == 0
    package = folder / NAME / NAME
    for file, old, new in (
        ("messages.py", "", SCRATCH),
        ("__init__.py", "TRAVELLED,)", "TRAVELLED, SCRATCH)"),
        ("__init__.py", "import TRAVELLED", "import SCRATCH, TRAVELLED"),
        ("core.py", "[Output(TRAVELLED, travelled)]", "[Output(TRAVELLED, travelled), Output(SCRATCH, travelled)]"),
        ("core.py", "import TRAVELLED", "import SCRATCH, TRAVELLED"),
    ):
        text = (package / file).read_text()
        assert old in text
        (package / file).write_text(text.replace(old, new) if old else text + new)
    site = folder / "site"
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(site), str(folder / NAME)]
    subprocess.run(command, check=True)
    return site


@contextmanager
def on_path(site: Path) -> Iterator[None]:
    """The distributions in a directory count as installed until the end of the context."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        forget_third_parties()
        yield
    forget_third_parties()
    for name in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[name]
