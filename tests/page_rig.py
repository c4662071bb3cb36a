"""Fixtures: a browser, and the cockpit's page in it, against a made-up robot.

What they need is imported with the first test that asks for one, since most runs have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from cockpit_fake import FakeCockpit
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    from browser_rig import browser

    with browser() as started:
        yield started


@pytest.fixture
def fake() -> Iterator[FakeCockpit]:
    from cockpit_fake import FakeCockpit

    with FakeCockpit() as served:
        yield served


@pytest.fixture
def page(chromium: Browser, fake: FakeCockpit) -> Iterator[Page]:
    from browser_rig import opened

    with opened(chromium, fake.url) as shown:
        yield shown
