#!/usr/bin/env bash
# The simulated robot fetches the red can in the paper's scene. Writes to out/ the picture at the grasp, the capture of
# the run and the logs. It uses a separate mesh, so that it does not disturb a robot that is up on this machine.
set -euo pipefail
cd "$(dirname "$0")/.."
cocoro=$PWD/.venv/bin/cocoro
mkdir -p out
COCORO_RUN_DIR=$(mktemp -d)
export COCORO_RUN_DIR
rm -rf out/captures out/state
export COCORO_CAPTURE_DIR=$PWD/out/captures COCORO_STATE_DIR=$PWD/out/state

finish() {
    "$cocoro" down >/dev/null || true
    rm -rf out/logs
    cp -r "$COCORO_RUN_DIR"/*/logs out/logs 2>/dev/null || true
    rm -rf "$COCORO_RUN_DIR"
}
trap finish EXIT

"$cocoro" up sim --detach
"$cocoro" fetch red_can --snapshot out/grasp.png
