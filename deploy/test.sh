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

# Tests that measure real time run alone, since load would falsify their times. The others run on two workers; each file
# stays on one of them, so that what a file's tests share is made once. Files run in the order of their names: by default
# those with few tests come last, and the longest test, the README's, would end alone.
if [ $# = 0 ]; then
    echo "== pytest on two workers, without the tests that measure real time"
    pytest -rs -n 2 --dist loadfile --no-loadscope-reorder -m "not zenoh"
    tests=$?
    set -- -m zenoh
fi
echo "== pytest $*"
pytest -rs "$@" || tests=$?
[ ${#unclean[@]} = 0 ] && exit "${tests:-0}"
exit 1
