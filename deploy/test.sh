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

# Tests that measure real time closely run one by one, then the others that use zenoh or measure real time on a few
# workers, since they wait more than they compute. Meanwhile all other tests run on two workers with the processor time
# that is left, so that they do not falsify those times: in the class SCHED_IDLE and, since Linux shares the processor
# between sessions first, in a session of the least weight. Without chrt and setsid (util-linux) they run before. Each
# file stays on one worker, so that what its tests share is made once. Files run in the order that `tests/run_record.py`
# gives: by default those with few tests come last, and a long test would end alone.
spread=(--dist loadfile --no-loadscope-reorder)
others=(pytest -rs -n 2 "${spread[@]}" -m "not zenoh")
alone=(pytest -rs -m "zenoh and alone")
beside=(pytest -rs -n 3 "${spread[@]}" -m "zenoh and not alone")
record=$PWD/out/tests
tests=0
rm -rf "$record/new"
mkdir -p "$record/new"
export COCORO_TESTS_RECORD=$record/new
said=$(mktemp)
waited=() # what is to be ended with this script
python tests/run_memory.py "$COCORO_TESTS_RECORD" &
memory=$!
trap 'kill $memory "${waited[@]}" 2>/dev/null; rm -f "$said"' EXIT
trap 'exit 130' INT TERM # after pytest has ended, which hears Ctrl-C, too

run() {
    echo "== $*"
    "$@" || tests=$?
}

begun=$SECONDS
if { command -v chrt && command -v setsid; } >/dev/null; then
    aside='{ echo 19 >/proc/self/autogroup; } 2>/dev/null; exec chrt --idle 0 "$@"'
    setsid bash -c "$aside" aside "${others[@]}" >"$said" 2>&1 &
    waited=($!)
    run "${alone[@]}"
    run "${beside[@]}"
    echo "== ${others[*]}, which began with the others"
    wait "${waited[0]}" || tests=$?
    waited=()
    cat "$said"
else
    run "${others[@]}"
    run "${alone[@]}"
    run "${beside[@]}"
fi
kill $memory
wait $memory
echo "$((SECONDS - begun))" >"$record/new/seconds"
rm -rf "$record/last"
mv "$record/new" "$record/last"
python -m bench tests || true # what each file took; its bounds are for a quiet machine
[ ${#unclean[@]} = 0 ] && exit $tests
exit 1
