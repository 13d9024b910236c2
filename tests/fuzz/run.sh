#!/usr/bin/env bash
# run.sh SECONDS DIRECTORY
# Runs every fuzz target in DIRECTORY for SECONDS, all with the same seed. Inputs worth keeping stay
# in DIRECTORY/corpus and are where the next run starts; what breaks a target is kept in
# DIRECTORY/findings. Fails if there is any.
set -euo pipefail

seconds=$1
directory=$2
cd "$directory"
mkdir -p findings
failed=0
table=$(printf '%-28s %12s %9s %9s %9s' target executions per_s coverage findings)
for target in ./*_fuzz; do
  name=$(basename "$target")
  mkdir -p "corpus/$name"
  echo "== Fuzzing $name for $seconds s"
  code=0
  "$target" -max_total_time="$seconds" -seed=1 -timeout=20 -rss_limit_mb=4096 -max_len=4096 \
    -print_final_stats=1 -artifact_prefix="findings/$name-" "corpus/$name" \
    > "$name.log" 2>&1 || code=$?
  executions=$(sed -n 's/^stat::number_of_executed_units: *//p' "$name.log")
  coverage=$(sed -n 's/.* cov: \([0-9]*\) .*/\1/p' "$name.log" | tail -1)
  finding=0
  if [[ $code -ne 0 ]]; then
    finding=1
    failed=1
    grep -v '^#[0-9]' "$name.log" | tail -40
  fi
  table+=$'\n'$(printf '%-28s %12s %9s %9s %9s' "$name" "${executions:-0}" \
    "$((${executions:-0} / (seconds > 0 ? seconds : 1)))" "${coverage:-0}" "$finding")
done
echo "$table"
exit $failed
