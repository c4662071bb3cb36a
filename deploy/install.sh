#!/usr/bin/env bash
# Makes .venv and installs the project with pinned versions of its libraries. On Debian and Ubuntu it also installs the
# GL libraries that the fast renderer needs; without them the simulator uses a slower renderer. Does nothing when
# everything is installed already.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

# A .venv contains its own path, so a checkout that was moved needs a new one.
installed=.venv/.installed
wanted="$PWD $(cat pyproject.toml constraints.txt deploy/install.sh | sha256sum)"
if [ "$(cat $installed 2>/dev/null)" = "$wanted" ] && .venv/bin/python -c '' 2>/dev/null; then
    exit 0
fi

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "Python 3.11 or newer is needed; name one with PYTHON=... make install" >&2
    exit 2
}

have_gl() {
    local libraries
    libraries=$(ldconfig -p 2>/dev/null) || return 1
    [[ $libraries == *libEGL.so.1* && $libraries == *libGL.so.1* ]] &&
        { compgen -G '/usr/lib/*/dri/*swrast*' || compgen -G '/usr/lib/*/libgallium*'; } >/dev/null
}
if ! have_gl; then
    if command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; then
        sudo=$([ "$(id -u)" = 0 ] || echo sudo)
        echo "Installing the GL libraries libegl1 libgl1 libgl1-mesa-dri"
        { $sudo apt-get update -qq && $sudo apt-get install -y -qq libegl1 libgl1 libgl1-mesa-dri; } >/dev/null ||
            echo "The GL libraries could not be installed: the simulator will render slowly." >&2
    else
        echo "For the fast renderer install libegl1 libgl1 libgl1-mesa-dri (or your system's equivalents)." >&2
    fi
fi

if [[ "$(cat $installed 2>/dev/null)" != "$PWD "* ]] || ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    echo "Making .venv"
    rm -rf .venv
    if ! "$python" -m venv .venv 2>/dev/null; then
        # On Debian the part of venv that installs pip is in a separate package (python3-venv): use this Python's pip.
        rm -rf .venv
        "$python" -m venv --without-pip .venv && "$python" -m pip --python .venv/bin/python install --quiet pip || {
            echo "A virtual environment cannot be made; on Debian: apt-get install python3-venv" >&2
            exit 2
        }
    fi
fi

echo "Installing the project, the simulator and the tools of its tests (docs/install.md has smaller installations)"
PYTHONUNBUFFERED=1 .venv/bin/python -m pip install --progress-bar off --disable-pip-version-check \
    --log .venv/install.log -c constraints.txt -e '.[dev]' 2>&1 | "$python" deploy/install_progress.py || {
    echo "The installation failed; all that pip said is in .venv/install.log" >&2
    exit 2
}
.venv/bin/python deploy/install_progress.py sizes
mkdir -p .venv/share/man/man1 && ln -sf "$PWD/docs/cocoro.1" .venv/share/man/man1/ # pip leaves it out of editable installs
echo "$wanted" >$installed
