#!/usr/bin/env bash
# copy_piece.sh PIECE DIRECTORY: copies the headers of one piece of the library, with those that they
#   include and the licence, to DIRECTORY/tilt_ropter.
# copy_piece.sh --table [COMPILER]: prints the table of cmake/README.md: headers, lines, and the
#   processor time for compiling a file that includes the piece, in units of one with Eigen/Dense.
set -euo pipefail
shopt -s inherit_errexit

include=$(realpath "$(dirname "${BASH_SOURCE[0]}")/../include")
declare -A headers=(
  [allocation]=actuation/allocation.hpp
  [observer]=estimation/wrench_observer.hpp
  [servo]=actuation/servo.hpp
  [solver]='optimal_control/multiple_shooting.hpp optimal_control/auto_diff_problem.hpp'
  [filter]='estimation/ekf.hpp estimation/measurement_models.hpp'
  [controller]=control/nmpc.hpp
)
pieces='allocation observer servo solver filter controller'

closure() {  # HEADER...: these and all that they include, one a line
  (cd "$include" && grep -r '^#include <tilt_ropter/' tilt_ropter) |
    sed 's/:#include </ /; s/>.*//' | awk -v wanted="${*/#/tilt_ropter/}" '
      { includes[$1] = includes[$1] " " $2 }
      function reach(headers, i, n, header) {
        n = split(headers, header, " ")
        for (i = 1; i <= n; ++i)
          if (!seen[header[i]]++) { print header[i]; reach(includes[header[i]]) }
      }
      END { reach(wanted) }' | sort
}

processor_time() {  # HEADER...: [s]
  printf '#include <%s>\n' "$@" > "$away/piece.cpp"
  local TIMEFORMAT='%U %S'
  { time "$compiler" -std=c++17 -O2 -I "$include" -isystem "${EIGEN_DIR:-/usr/include/eigen3}" \
    -c "$away/piece.cpp" -o "$away/piece.o"; } 2>&1 | awk '{ print $1 + $2 }'
}

if [[ ${1:-} == --table ]]; then
  compiler=${2:-g++}
  away=$(mktemp -d)
  trap 'rm -rf "$away"' EXIT
  eigen=$(processor_time Eigen/Dense)
  echo "| piece | include | headers | lines | compiles in, Eigen/Dense = 1 |"
  echo "|---|---|---|---|---|"
  for piece in $pieces; do
    read -ra own <<< "${headers[$piece]}"
    files=$(closure "${own[@]}")
    lines=$(cd "$include" && xargs cat <<< "$files" | wc -l)
    time=$(processor_time "${own[@]/#/tilt_ropter/}")
    includes=$(printf ', `%s`' "${own[@]}")
    echo "| $piece | ${includes:2} | $(wc -l <<< "$files") | $lines |" \
      "$(awk -v t="$time" -v e="$eigen" 'BEGIN { printf "%.1f", t / e }') |"
  done
  exit
fi
if (($# != 2)) || [[ -z ${headers[$1]:-} ]]; then
  sed -n '2,5s/^# //p' "${BASH_SOURCE[0]}"
  echo "pieces: $pieces"
  [[ ${1:-} == --help ]] && exit 0 || exit 2
fi
read -ra own <<< "${headers[$1]}"
mkdir -p "$2"
to=$(realpath "$2")
(cd "$include" && closure "${own[@]}" | xargs cp --parents --target-directory "$to")
cp "$include/../LICENSE" "$2/tilt_ropter/LICENSE"
echo "$1: include <tilt_ropter/${own[0]}>"
