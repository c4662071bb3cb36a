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

# The tests start hundreds of processes, each of which would compile the project's modules again.
unset PYTHONDONTWRITEBYTECODE

# Arguments go to pytest.
if [ $# -gt 0 ]; then
    echo "== pytest $*"
    pytest -rs "$@"
    tests=$?
    [ ${#unclean[@]} = 0 ] && exit $tests
    exit 1
fi

# Which tests run beside which, and why: tests/run_spread.py. What each file takes, and the memory of all, is kept in
# out/tests/last.
record=$PWD/out/tests
rm -rf "$record/new"
mkdir -p "$record/new"
export COCORO_TESTS_RECORD=$record/new
python tests/run_memory.py "$record/new" &
memory=$!
trap 'kill $memory 2>/dev/null' EXIT
trap 'exit 130' INT TERM # after pytest has ended, which hears Ctrl-C, too
begun=$SECONDS
echo "== pytest --spread"
pytest -rs --spread
tests=$?
kill $memory
wait $memory
echo "$((SECONDS - begun))" >"$record/new/seconds"
rm -rf "$record/last"
mv "$record/new" "$record/last"
python -m bench tests || true # its bounds are for a machine that does nothing else
[ ${#unclean[@]} = 0 ] && exit $tests
exit 1
