"""Zenoh opens links with the options of credentials, and refuses those of another site, as Python's ssl does."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh
from site_rig import DAY

from deploy.site import authority, credentials

pytestmark = pytest.mark.zenoh
NOW = datetime.now(UTC)
WORD = "a word"
HERE, BESIDE = "127.0.0.1", "127.0.0.2"
"""The robot listens at both addresses; its certificate has the first."""


@contextmanager
def session(options: dict[str, Any], **more: Any) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    for path, value in {"scouting/multicast/enabled": False, **options, **more}.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as opened:
        yield opened


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("sites")
    for site in ("lab", "other"):
        authority.init(place / site, NOW - 100 * DAY)
        authority.issue(place / site, "operator", "ada", NOW)
    authority.issue(place / "lab", "robot", "base", NOW, addresses=[HERE])
    authority.issue(place / "lab", "viewer", "late", NOW - 100 * DAY)
    return place


@pytest.fixture
def endpoint(sites: Path) -> Iterator[str]:
    """Where the robot of the first site listens, and answers with a word."""
    with socket.socket() as free:
        free.bind((HERE, 0))
        port = free.getsockname()[1]
    options = credentials.read(sites / "lab" / "credentials" / "base", NOW).options
    endpoint = f"tls/{HERE}:{port}"
    with session(
        options, **{"mode": "router", "listen/endpoints": [endpoint, endpoint.replace(HERE, BESIDE)]}
    ) as robot:
        robot.declare_queryable("word", lambda query: query.reply("word", WORD))
        yield endpoint


def word(folder: Path, endpoint: str, address: str = HERE) -> str:
    """What the robot answers to a client with these credentials. Raises ZError when no link comes about."""
    name = folder.name
    options = credentials.read(folder, NOW - 50 * DAY if name == "late" else NOW, name=name).options
    with session(
        options, **{
            "mode": "client", "connect/endpoints": [endpoint.replace(HERE, address)],
            "connect/timeout_ms": 0, "connect/exit_on_failure": True,
        },
    ) as client:  # fmt: skip
        (reply,) = client.get("word", timeout=60.0)
        assert reply.ok is not None
        return reply.ok.payload.to_string()


def test_a_principal_of_the_site_has_a_link_and_its_next_generation_too(sites: Path, endpoint: str) -> None:
    folder = sites / "lab" / "credentials" / "ada"
    assert word(folder, endpoint) == WORD
    authority.renew(sites / "lab", "ada", NOW)
    assert word(folder, endpoint) == WORD


@pytest.mark.parametrize("who", ["other/credentials/ada", "lab/credentials/late"])
def test_one_of_another_site_or_whose_certificate_has_expired_has_none(sites: Path, endpoint: str, who: str) -> None:
    with pytest.raises(zenoh.ZError):
        word(sites / who, endpoint)


def test_a_robot_at_an_address_that_its_certificate_does_not_have_is_not_believed(sites: Path, endpoint: str) -> None:
    with pytest.raises(zenoh.ZError):
        word(sites / "lab" / "credentials" / "ada", endpoint, BESIDE)
