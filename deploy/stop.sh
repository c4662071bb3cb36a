#!/usr/bin/env bash
# Stops a robot's processes. The arguments are those of `cocoro down`.
set -euo pipefail
exec "$(dirname "$0")/../.venv/bin/cocoro" down "$@"
