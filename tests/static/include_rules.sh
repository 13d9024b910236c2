#!/usr/bin/env bash
# include_rules.sh INCLUDE_DIR
# Checks which folder of INCLUDE_DIR/tilt_ropter includes which, that only a folder's own headers
# include what is in its detail/, how many headers a user sees, and that each header names its
# licence, so that a copied header keeps it. Prints every violation; fails if there is one.
set -euo pipefail
shopt -s inherit_errexit

cd "$1"
umbrella=tilt_ropter/tilt_ropter.hpp
# For users who link to their instances.
compiled='tilt_ropter/compiled.hpp tilt_ropter/compiled_actuator_level.hpp'
# Used at a desk, or for NLopt alone: they would cost every includer of the umbrella time.
not_in_umbrella='identification/.*|optimal_control/(derivative_check|single_shooting).hpp'
headers=$(find tilt_ropter -name '*.hpp' ! -path $umbrella ! -path 'tilt_ropter/compiled*' | sort)
public=$(grep -v /detail/ <<< "$headers")
# Lines like "tilt_ropter/model/state.hpp <tilt_ropter/math/rotation.hpp>".
includes=$(grep -rE --include='*.hpp' '^\s*#\s*include\b' tilt_ropter |
  sed -E 's/:\s*#\s*include\s*([<"][^>"]*[>"]).*/ \1/')

violations=$(
  awk -v umbrella=$umbrella -v compiled="$compiled" '
    BEGIN {
      may["math"] = "math"
      may["model"] = "math model"
      may["actuation"] = "math model actuation"
      may["estimation"] = "math model estimation"
      may["identification"] = "math model estimation identification"
      may["planning"] = "math model planning"
      may["optimal_control"] = "math optimal_control"
      may["control"] = "math model actuation optimal_control control"
      may["simulation"] = "math model actuation simulation"
      # Whose detail/ a folder may include beside its own and that of math.
      parts["actuation"] = "model"
      parts["control"] = "model actuation optimal_control"
      parts["identification"] = "estimation"
    }
    function among(words, word) { return index(" " words " ", " " word " ") }
    {
      split($1, header, "/")
      split($2, included, "/")
      room = header[2]
      if ($2 ~ /^<tilt_ropter\//)
        ok = $1 == umbrella || index(compiled, $1) || (among(may[room], included[2]) && \
          (included[3] != "detail" || included[2] == room || included[2] == "math" || \
           among(parts[room], included[2])))
      else if ($2 == "<nlopt.h>")
        ok = room == "optimal_control"
      else  # Eigen and the standard library
        ok = $2 ~ /^<(unsupported\/)?Eigen\/[A-Za-z]+>$/ || $2 ~ /^<[a-z_]+>$/
      if (!ok) print $1 " may not include " $2
    }' <<< "$includes"
  awk 'FNR == 1 && $0 != "// SPDX-License-Identifier: BSD-3-Clause" {
    print FILENAME " does not name its licence in the first line" }' $headers $umbrella $compiled
  # A folder shows at most eight names, and all folders at most 48 headers.
  for folder in tilt_ropter/*/; do
    (($(grep -c "^$folder" <<< "$public") <= 8)) || echo "$folder has more than 8 public headers"
  done
  (($(wc -l <<< "$public") + 3 <= 48)) || echo "more than 48 public headers"
  (($(grep -c "^$umbrella <tilt_ropter/" <<< "$includes") <= 30)) ||
    echo "$umbrella includes more than 30 headers directly"
  # With `#pragma once` the compiler does not detect circular includes.
  pairs=$(sed -nE 's/ <(tilt_ropter\/.*)>/ \1/p' <<< "$includes")
  reached=$(awk -v umbrella=$umbrella '
    { includes[$1] = includes[$1] " " $2 }
    function reach(headers, i, n, header) {
      n = split(headers, header, " ")
      for (i = 1; i <= n; ++i)
        if (!seen[header[i]]++) { print header[i]; reach(includes[header[i]]) }
    }
    END { reach(umbrella) }' <<< "$pairs" | sort)
  comm -13 <(echo "$reached") <(grep -vxE "tilt_ropter/($not_in_umbrella)" <<< "$public") |
    sed "s|^|$umbrella does not include |"
  tsort <<< "$pairs" 2>&1 > /dev/null | sed -n 's/^tsort: tilt/in a circle: tilt/p' || true
)

if [[ $violations ]]; then
  echo "$violations"
  exit 1
fi
echo "include rules hold"
