"""The roles of a site: what a host or a person is. `deploy.site.rights` says what each may do."""

from __future__ import annotations

from typing import Literal, get_args

HostRole = Literal["robot", "brain", "hub"]
PersonRole = Literal["operator", "viewer", "author"]
Role = Literal["robot", "brain", "hub", "operator", "viewer", "author"]
ROLES: tuple[Role, ...] = get_args(Role)
