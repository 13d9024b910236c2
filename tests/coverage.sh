#!/usr/bin/env bash
# coverage.sh BUILD_DIRECTORY PERCENT
# Reports which lines of include/ the tests in BUILD_DIRECTORY executed. The tests must be built
# with clang's coverage mapping and run with LLVM_PROFILE_FILE below BUILD_DIRECTORY/profiles/.
# Writes to BUILD_DIRECTORY/report/: a table per header, the lines not reached, and all lines as
# HTML. A template line counts as reached if one instantiation reached it. Fails below PERCENT of
# all lines.
set -euo pipefail

build=$1
least=$2
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
report=$build/report
rm -rf "$report"
mkdir -p "$report"

llvm-profdata merge -sparse "$build"/profiles/*.profraw -o "$report/all.profdata"
what=(-instr-profile="$report/all.profdata")
for program in "$build"/tests/*_test "$build"/tests/*_tests "$build"/examples/* "$build"/examples/mujoco/*; do
  if [[ -f $program && -x $program ]]; then
    [[ ${#what[@]} -eq 1 ]] || what+=(-object)
    what+=("$program")
  fi
done
what+=("$source/include")
llvm-cov export -format=lcov "${what[@]}" > "$report/lines.lcov"
llvm-cov show -format=html -output-dir="$report" -show-instantiations=false "${what[@]}"

awk -v prefix="$source/include/" -v not_reached="$report/not_reached.txt" -v least="$least" '
  function row(name, hit, all) {
    return sprintf("%-56s %6d %6d %7.2f %%", name, all, hit, 100 * hit / all)
  }
  BEGIN {
    sorted = "sort"
    printf "%-56s %6s %6s\n", "header", "lines", "hit"
    fflush()
  }
  /^SF:/ { name = substr($0, 4 + length(prefix)); hit = all = 0 }
  /^DA:/ {
    split(substr($0, 4), line, ",")
    ++all
    if (line[2] > 0) ++hit
    else print name ":" line[1] > not_reached
  }
  /^end_of_record/ && all > 0 {
    print row(name, hit, all) | sorted
    total += all
    total_hit += hit
  }
  END {
    if (total == 0) { print "no lines of include/ were built in"; exit 1 }
    close(sorted)
    print row("include/", total_hit, total)
    if (100 * total_hit < least * total) { print "less than " least " %"; exit 1 }
  }' "$report/lines.lcov" | tee "$report/table.txt"
