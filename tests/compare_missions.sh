#!/usr/bin/env bash
# compare_missions.sh DIRECTORY DIRECTORY LIMIT
# Compares two runs of hybrid_mission. Each directory has the standard output, figures.txt, and the
# log, hybrid_mission.csv. Compares the printed figures, except computing times, and the RMS of each
# column of the log. Prints the largest relative difference; fails if it is above LIMIT.
set -euo pipefail

if [[ ${1-} == --help || ${1-} == -h || $# -ne 3 ]]; then
  sed -n '2,5s/^# //p' "${BASH_SOURCE[0]}"
  exit 0
fi

figures() {  # directory
  awk -F ': ' '!/_us:|^real_time_factor:/ { print $1, $2 }' "$1/figures.txt"
  awk -F , 'NR == 1 { columns = split($0, name); next }
    { for (i = 1; i <= columns; ++i) squares[i] += $i * $i }
    END { for (i = 1; i <= columns; ++i)
            printf "rms_of_%s %.17g\n", name[i], sqrt(squares[i] / (NR - 1)) }' \
    "$1/hybrid_mission.csv"
}

first=$(figures "$1")
second=$(figures "$2")
paste -d ' ' <(echo "$first") <(echo "$second") | awk -v limit="$3" '
  function magnitude(x) { return x < 0 ? -x : x }
  NF != 4 || $1 != $3 || $2 $4 ~ /n/ { print "other figures, or not finite: " $0; bad = 1; exit }
  { larger = magnitude($2) > magnitude($4) ? magnitude($2) : magnitude($4)
    difference = larger > 0 ? magnitude($2 - $4) / larger : 0
    if (difference > largest) { largest = difference; where = " of " $1 } }
  END { printf "largest relative difference: %.2g%s, of %d figures; at most %g is allowed\n",
          largest, where, NR, limit
        exit bad || largest > limit }'
