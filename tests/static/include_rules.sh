#!/usr/bin/env bash
# include_rules.sh INCLUDE_DIR
# Checks which folder of INCLUDE_DIR/tilt_ropter includes which, and that each header names its
# licence, so that a copied header keeps it. Prints every violation; fails if there is one.
set -euo pipefail
shopt -s inherit_errexit

cd "$1"
umbrella=tilt_ropter/tilt_ropter.hpp
# For users who link to their instances.
compiled='tilt_ropter/compiled.hpp tilt_ropter/compiled_actuator_level.hpp'
# Used once, at a desk; each costs every includer of the umbrella a tenth of a second.
not_in_umbrella='model/propeller_clearance.hpp optimal_control/derivative_check.hpp
estimation/(clock_calibration|flight_windows|log_(calibration(_settings)?|smoother)|rotor_lag_fit|
servo_identification|vehicle_(fit|identification|log)|window_model).hpp'
headers=$(find tilt_ropter -name '*.hpp' ! -path $umbrella ! -path 'tilt_ropter/compiled*' | sort)
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
      may["planning"] = "math model planning"
      may["optimal_control"] = "math optimal_control"
      may["control"] = "math model actuation planning optimal_control control"
      may["simulation"] = "math model actuation planning simulation"
    }
    {
      split($1, header, "/")
      split($2, included, "/")
      room = header[2]
      if ($2 ~ /^<tilt_ropter\//)
        ok = $1 == umbrella || index(compiled, $1) || index(" " may[room] " ", " " included[2] " ")
      else if ($2 == "<nlopt.h>")
        ok = room == "optimal_control" || $1 ~ /estimation\/servo_identification.hpp$/
      else  # Eigen and the standard library
        ok = $2 ~ /^<(unsupported\/)?Eigen\/[A-Za-z]+>$/ || $2 ~ /^<[a-z_]+>$/
      if (!ok) print $1 " may not include " $2
    }' <<< "$includes"
  for header in $headers $umbrella $compiled; do
    [[ $(head -1 $header) == "// SPDX-License-Identifier: BSD-3-Clause" ]] ||
      echo "$header does not name its licence in the first line"
  done
  for header in $headers; do
    grep -qE "^tilt_ropter/(${not_in_umbrella//[ $'\n']/|})$" <<< "$header" ||
      grep -qF "$umbrella <$header>" <<< "$includes" || echo "$umbrella does not include $header"
  done
  # With `#pragma once` the compiler does not detect circular includes.
  pairs=$(sed -nE 's/ <(tilt_ropter\/.*)>/ \1/p' <<< "$includes")
  tsort <<< "$pairs" 2>&1 > /dev/null | sed -n 's/^tsort: tilt/in a circle: tilt/p' || true
)

if [[ $violations ]]; then
  echo "$violations"
  exit 1
fi
echo "include rules hold"
