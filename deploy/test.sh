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

# Tests that use zenoh or measure real time run one by one. Meanwhile the others run on two workers, with the processor
# time that is left, so that they do not falsify those times: in the class SCHED_IDLE and, since Linux shares the
# processor between sessions first, in a session of the least weight. Without chrt and setsid (util-linux) they run
# before. Each file stays on one worker, so that what its tests share is made once. Files run in the order of their
# names: by default those with few tests come last, and a long test would end alone.
others=(pytest -rs -n 2 --dist loadfile --no-loadscope-reorder -m "not zenoh")
tests=0
if [ $# -gt 0 ]; then
    echo "== pytest $*"
    pytest -rs "$@" || tests=$?
elif ! { command -v chrt && command -v setsid; } >/dev/null; then
    echo "== ${others[*]}"
    "${others[@]}" || tests=$?
    echo "== pytest -m zenoh"
    pytest -rs -m zenoh || tests=$?
else
    said=$(mktemp)
    aside='{ echo 19 >/proc/self/autogroup; } 2>/dev/null; exec chrt --idle 0 "$@"'
    setsid bash -c "$aside" aside "${others[@]}" >"$said" 2>&1 &
    trap 'kill $! 2>/dev/null; rm -f "$said"' EXIT
    trap 'exit 130' INT TERM # after pytest has ended, which hears Ctrl-C, too
    echo "== pytest -m zenoh"
    pytest -rs -m zenoh || tests=$?
    echo "== ${others[*]}, which began with the others"
    wait $! || tests=$?
    cat "$said"
fi
[ ${#unclean[@]} = 0 ] && exit $tests
exit 1
