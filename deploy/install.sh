#!/usr/bin/env bash
# Makes .venv and installs the project into it, with the pinned versions. On Debian and Ubuntu it also installs
# the GL libraries that the fast renderer needs; without them the simulator falls back to a slower renderer.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

"$python" - <<'PY' || { echo "Python 3.11 or newer is needed; name one with PYTHON=... make install" >&2; exit 2; }
import sys
sys.exit(sys.version_info < (3, 11))
PY

have_gl() { ldconfig -p 2>/dev/null | grep -q libEGL.so.1 && ldconfig -p | grep -q libGL.so.1 && ls /usr/lib/*/dri/*swrast* /usr/lib/*/libgallium* >/dev/null 2>&1; }
if ! have_gl; then
    if command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; then
        sudo=$([ "$(id -u)" = 0 ] || echo sudo)
        $sudo apt-get update -qq && $sudo apt-get install -y -qq libegl1 libgl1 libgl1-mesa-dri >/dev/null ||
            echo "The GL libraries could not be installed: the simulator will render slowly." >&2
    else
        echo "For the fast renderer install libegl1 libgl1 libgl1-mesa-dri (or your system's equivalents)." >&2
    fi
fi

[ -x .venv/bin/python ] || "$python" -m venv .venv || {
    echo "A virtual environment cannot be made; on Debian: apt-get install python3-venv" >&2
    exit 2
}
.venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
