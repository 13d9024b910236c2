#!/usr/bin/env bash
# run.sh SECONDS DIRECTORY
# Runs every fuzz target in DIRECTORY for SECONDS, one per processor at a time, all with the same
# seed. Keeps useful inputs in DIRECTORY/corpus, where the next run starts, and failing inputs in
# DIRECTORY/findings. Fails if there are findings.
set -euo pipefail

export seconds=$1
cd "$2"
mkdir -p findings
rm -f ./*_fuzz.log ./*_fuzz.code

fuzz() {  # target
  local name code=0
  name=$(basename "$1")
  mkdir -p "corpus/$name"
  echo "== Fuzzing $name for $seconds s"
  "$1" -max_total_time="$seconds" -seed=1 -timeout=20 -rss_limit_mb=4096 -max_len=4096 \
    -print_final_stats=1 -artifact_prefix="findings/$name-" "corpus/$name" \
    > "$name.log" 2>&1 || code=$?
  echo $code > "$name.code"
}
export -f fuzz
printf '%s\0' ./*_fuzz | xargs -0 -n 1 -P "$(nproc)" bash -c 'fuzz "$0"'

failed=0
row='%-28s %12s %9s %9s %9s\n'
table=$(printf "$row" target executions per_s coverage findings)
for target in ./*_fuzz; do
  name=$(basename "$target")
  executions=$(sed -n 's/^stat::number_of_executed_units: *//p' "$name.log")
  coverage=$(sed -n 's/.* cov: \([0-9]*\) .*/\1/p' "$name.log" | tail -1)
  finding=0
  if [[ $(cat "$name.code") -ne 0 ]]; then
    finding=1
    failed=1
    echo "== $name found:"
    grep -v '^#[0-9]' "$name.log" | tail -40
  fi
  table+=$'\n'$(printf "$row" "$name" "${executions:-0}" \
    "$((${executions:-0} / (seconds > 0 ? seconds : 1)))" "${coverage:-0}" "$finding")
done
echo "$table"
exit $failed
