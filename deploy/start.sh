#!/usr/bin/env bash
# Starts a robot's processes and returns when they are ready. The arguments are those of `cocoro up`: start.sh robot
set -euo pipefail
exec "$(dirname "$0")/../.venv/bin/cocoro" up --detach "$@"
