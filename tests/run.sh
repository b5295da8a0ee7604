#!/usr/bin/env bash
# Runs every check and ends with one line: N passed, N failed, N skipped. Logs are kept in target/test-logs.
#
# A test that can't run here prints a line "SKIPPED: why" (in any case) and returns; it is then counted as skipped, not as passed.
cd "$(dirname "$0")/.." || exit 1
logs=target/test-logs
mkdir -p "$logs"
passed=0 failed=0 skipped=0

[ -e .venv/ready ] && export MULTISTAGE_PYTHON="$PWD/.venv/bin/python"

# check NAME COMMAND...: one check, by its exit status; its output is shown when it fails.
check() {
  local name=$1 log=$logs/${1// /-}.log
  shift
  if "$@" >"$log" 2>&1; then
    echo "ok      $name"
    passed=$((passed + 1))
  else
    echo "FAILED  $name"
    tail -n 60 "$log"
    failed=$((failed + 1))
  fi
}

# skip NAME WHY
skip() {
  echo "SKIPPED $1: $2"
  skipped=$((skipped + 1))
}

if cargo fmt --version >/dev/null 2>&1; then check "rustfmt" cargo fmt --check; else skip "rustfmt" "cargo fmt is not installed"; fi
if cargo clippy --version >/dev/null 2>&1; then
  check "clippy" cargo clippy --locked --all-targets -- -D warnings
else
  skip "clippy" "cargo clippy is not installed"
fi

# Rust tests. --show-output keeps what passing tests printed, so that SKIPPED lines can be counted, one a test.
log=$logs/cargo.log
cargo test --locked --no-fail-fast -- --show-output >"$log" 2>&1
status=$?
read -r p f s < <(awk '
  /^test result:/ { for (i = 1; i < NF; i++) { if ($(i+1) == "passed;") p += $i; if ($(i+1) == "failed;") f += $i; if ($(i+1) == "ignored;") s += $i } binary++ }
  /^---- .* stdout ----$/ { test = binary "/" $2 }
  tolower($0) ~ /^skipped:/ && !(test in seen) { seen[test] = 1; skips++ }
  END { print p - skips, f + 0, s + skips }' "$log")
# A test program that does not compile or dies reports no result of its own.
[ "$status" != 0 ] && [ "$f" = 0 ] && f=1
grep -iE '^(skipped:|test .* failed|error)' "$log" | sort -u
[ "$status" != 0 ] && grep -vE '^(test .* ok|running|     Running|successes:|warning)' "$log" | tail -n 80
echo "cargo test: $p passed, $f failed, $s skipped"
passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))

# The page, in a browser, on the service as built above.
log=$logs/browser.tap
MULTISTAGE_BIN="$PWD/target/debug/multistage" node --test --test-concurrency=1 \
  --test-reporter=spec --test-reporter-destination=stdout --test-reporter=tap --test-reporter-destination="$log" \
  tests/page/*.test.mjs
status=$?
read -r p f s < <(awk '/^# pass /{p=$3} /^# (fail|cancelled) /{f+=$3} /^# (skipped|todo) /{s+=$3} END {print p+0, f+0, s+0}' "$log")
[ "$status" != 0 ] && [ "$f" = 0 ] && f=1
echo "browser tests: $p passed, $f failed, $s skipped"
passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))

echo "$passed passed, $failed failed, $skipped skipped"
[ "$failed" = 0 ]
