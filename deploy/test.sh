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

echo "== pytest $*"
pytest -rs "$@"
tests=$?
[ ${#unclean[@]} = 0 ] && exit $tests
exit 1
