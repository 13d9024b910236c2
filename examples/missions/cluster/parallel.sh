#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<HELP
usage: parallel.sh [--jobs N] [OPTION VALUE...]

Spreads monte_carlo over the processors of this computer with GNU parallel (Debian: parallel), then
merges the parts. For other computers that share this directory, set the variable PARALLEL, such as
PARALLEL='--sshloginfile hosts --workdir .'.

  --jobs N           jobs at a time [one per processor]
$common_help
HELP
}

# shellcheck source=parts.sh
source "$(dirname "${BASH_SOURCE[0]}")/parts.sh"
read_options "$@"
[[ ! $wait ]] || fail "--wait: it always waits"
parallel --version 2> /dev/null | grep -q '^GNU parallel' ||
  fail "GNU parallel is missing (Debian: apt-get install parallel)"

options=(--will-cite --colsep ' ' --joblog "$output/parts/jobs.log")
if [[ $jobs ]]; then options+=(--jobs "$jobs"); fi
if [[ -t 2 ]]; then options+=(--bar); fi
printf -v log '%q' "$output/parts"
failed=0
for ((from = first; from < end; from += chunk)); do
  echo "$from $((from + chunk < end ? chunk : end - from))"
done | parallel "${options[@]}" "$(part_command '{1}' '{2}') >> $log/{1}.log 2>&1" || failed=$?
if [[ $failed -ne 0 ]]; then
  case $failed in
    101) failed="more than 100" ;;
    10[2-9] | 1[1-9][0-9] | 2[0-9][0-9]) fail "GNU parallel failed with exit code $failed" ;;
  esac
  echo "$failed of $parts jobs failed; the first of them:" >&2
  row=$(awk -F '\t' 'NR > 1 && ($7 != 0 || $8 != 0) {
      print "exit code " $7 ", signal " $8 ": " $9; exit }' "$output/parts/jobs.log")
  echo "$row" >&2
  from=${row##* --first }
  tail -n 3 "$output/parts/${from%% *}.log" >&2 || true
  echo "the same command goes on with the vehicles that are missing" >&2
fi
exec bash -c "$(merge_command)"
