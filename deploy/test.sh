#!/usr/bin/env bash
# Runs every check: lint, format, types, import rules, tests. It continues after a failure, so that one run shows all of
# them; the tests come last. Arguments go to pytest.
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

# Tests of real processes run alone; the others go by virtual time and run in parallel.
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
