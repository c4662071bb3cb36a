#!/usr/bin/env bash
# Runs every check: lint, format, types, import rules, tests. It continues after a failure, so that one run shows all of
# them. Arguments go to pytest.
set -uo pipefail
cd "$(dirname "$0")/.."
PATH=$PWD/.venv/bin:$PATH
unclean=()

check() {
    echo "== $*"
    "$@" || unclean+=("$1")
}

# The tests start hundreds of processes, each of which would compile the project's modules again.
unset PYTHONDONTWRITEBYTECODE

check ruff check .
check ruff format --check .
if [ $# -gt 0 ]; then
    check mypy
    check lint-imports --no-logo
    check pytest -rs "$@"
else
    # Types and import rules are checked beside the tests, with the processor time that is left; so are most tests.
    # Which tests run beside which, and why: tests/run_spread.py. What each file takes, and the memory of all, is kept
    # in out/tests/last.
    record=$PWD/out/tests
    rm -rf "$record/new"
    mkdir -p "$record/new"
    export COCORO_TESTS_RECORD=$record/new
    python tests/run_memory.py "$record/new" &
    memory=$!
    said=$(mktemp)
    aside='{ echo 19 >/proc/self/autogroup; chrt --idle --pid 0 $$; } >/dev/null 2>&1
        for words in "mypy" "lint-imports --no-logo"; do echo "== $words"; $words || failed=1; done; exit ${failed:-0}'
    command -v setsid >/dev/null || setsid() { "$@"; }
    setsid bash -c "$aside" >"$said" 2>&1 &
    types=$!
    trap 'kill $memory $types 2>/dev/null; rm -f "$said"' EXIT
    trap 'exit 130' INT TERM # after pytest has ended, which hears Ctrl-C, too
    begun=$SECONDS
    COCORO_TESTS_CHECKS=$types check pytest -rs --spread
    wait $types || unclean+=("types or import rules")
    cat "$said"
    kill $memory
    wait $memory
    echo "$((SECONDS - begun))" >"$record/new/seconds"
    rm -rf "$record/last"
    mv "$record/new" "$record/last"
    python -m bench tests || true # its bounds are for a machine that does nothing else
fi
[ ${#unclean[@]} = 0 ] && exit 0
echo "NOT CLEAN: ${unclean[*]}"
exit 1
