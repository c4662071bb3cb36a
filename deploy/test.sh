#!/usr/bin/env bash
# Everything that must hold: lint, format, types, import rules, tests. Goes on after a failure, so that one run tells
# all; the tests come last. Arguments go to pytest.
set -uo pipefail
cd "$(dirname "$0")/.."
PATH=$PWD/.venv/bin:$PATH
unclean=()

check() {
    echo "== $*"
    "$@" || unclean+=("$1")
}

check ruff check .
check ruff format --check .
check mypy
check lint-imports --no-logo
[ ${#unclean[@]} = 0 ] || echo "NOT CLEAN: ${unclean[*]}"

# Tests of real processes have the machine for themselves; the others, which go by virtual time, share it.
if [ $# = 0 ]; then
    echo "== pytest, what goes by virtual time, on two processors"
    pytest -rs -n 2 -m "not zenoh"
    tests=$?
    set -- -m zenoh
fi
echo "== pytest $*"
pytest -rs "$@" || tests=$?
[ ${#unclean[@]} = 0 ] && exit "${tests:-0}"
exit 1
