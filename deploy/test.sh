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

# Tests that start processes or simulate a world have the machine for themselves; the others share it.
if [ $# = 0 ]; then
    echo "== pytest, what is pure, on two processors"
    pytest -rs -n 2 -m "not zenoh and not sim"
    tests=$?
    set -- -m "zenoh or sim"
fi
echo "== pytest $*"
pytest -rs "$@" || tests=$?
[ ${#unclean[@]} = 0 ] && exit "${tests:-0}"
exit 1
