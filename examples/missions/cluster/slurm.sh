#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<HELP
usage: slurm.sh [--jobs N] [--wait] [OPTION VALUE...]

Spreads monte_carlo over a cluster as a Slurm array, whose tasks each fly a part, and a job after
them that merges the parts. The directory must be shared by all nodes. Options of sbatch are given by
its variables: SBATCH_PARTITION, SBATCH_ACCOUNT, SBATCH_TIMELIMIT, SBATCH_CONSTRAINT. Take nodes with
processors of one kind: other processors round differently, and the parts do not merge.

  --jobs N           tasks at a time [as many as Slurm gives]
  --wait             wait for the merged table, print its figures and return its exit code
$common_help
HELP
}

# shellcheck source=parts.sh
source "$(dirname "${BASH_SOURCE[0]}")/parts.sh"
read_options "$@"
command -v sbatch > /dev/null || fail "Slurm is missing (Debian: apt-get install slurm-wlm)"

# Slurm replaces % in names of files by its own words.
log=${output//%/%%}
# shellcheck disable=SC2016  # the task expands it
task='from=$(('"$first + $chunk"' * SLURM_ARRAY_TASK_ID)); left=$(('"$end"' - from))
number=$((left < '"$chunk"' ? left : '"$chunk"'))
exec '$(part_command '"$from"' '"$number"')
array=$(sbatch --parsable --job-name=monte_carlo --requeue --open-mode=append --ntasks=1 \
  --cpus-per-task=1 --array="0-$((parts - 1))${jobs:+%$jobs}" --output="$log/parts/task_%a.log" \
  --wrap "$task") ||
  fail "Slurm did not take $parts tasks; its limit is MaxArraySize of scontrol show config, and a
larger --chunk gives fewer tasks"
echo "array of $parts tasks: job $array"
result=0
merged=$(sbatch --parsable --job-name=monte_carlo_merge --requeue --ntasks=1 \
  --dependency="afterany:${array%%;*}" --output="$log/merged.log" ${wait:+--wait} \
  --wrap "exec $(merge_command)") || result=$?
echo "merges to $output: job $merged"
if [[ $wait ]]; then cat "$output/merged.log"; fi
exit "$result"
